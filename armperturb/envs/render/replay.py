"""From a recorded trial to poses of the rig: what videos and the viewer show."""

from dataclasses import dataclass, replace
from typing import Any, Self

import mujoco
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy import signal

from armperturb.analysis.measures.kinematics import joint_rotations, start_posture
from armperturb.arrays import Array
from armperturb.environment import Strap
from armperturb.models.rig import build_model
from armperturb.recording import TRIAL_COORDINATES, is_one_axis
from armperturb.subject import RELAX

BODY = ("l_h", "l_f", "theta_s_deg", "theta_e_deg")
"""Coordinates of a trial that say what the arm looks like."""

SIGNALS = ("joint_angle", "shoulder_marker")
"""Optional variables of a recording that are looked at, where there are any."""

MARKER_CUTOFF = 15.0
"""Cut-off of the low-pass on the shoulder's marker [Hz]: its noise would make the picture tremble."""


@dataclass(frozen=True, kw_only=True)
class Replay:
    """One recorded trial to look at.

    Attributes:
      model: of the rig, with the arm of this person.
      time: [s], (time,).
      qpos: poses of the model, (time, nq).
      displacement: of the handle [m], (time, axis).
      disturbance: d on the manipulator [N], (time, axis).
      reaction: f that the handle exerts on the hand [N], (time, axis).
      title: subject, condition and pulse.
      pulse_onset: [s]; None without a pulse.
      limit_time: when the handle met the limit of the workspace, after which the signals mean nothing [s]; None if it
        never did.
    """

    model: mujoco.MjModel
    time: Array
    qpos: Array
    displacement: Array
    disturbance: Array
    reaction: Array
    title: str
    pulse_onset: float | None
    limit_time: float | None

    @classmethod
    def of_trial(cls, recording: xr.Dataset, trial: int, source: str = "recording") -> Self:
        """One trial of a recording.

        Joint angles are the recorded ones, else those that bring the hand to the handle. A shoulder's marker, where
        there is one, moves the shoulder; where there is none it stays.

        Args:
          recording: checked, as from `armperturb.recording.load_recording`.
          trial: which one, from 0.
          source: where the recording comes from, for the message.

        Raises:
          TypeError: trial is no whole number.
          ValueError: there is no such trial, the recording is of one axis, the trial does not say what the arm looks
            like, or its handle is out of reach.
        """
        n_trials = recording.sizes["trial"]
        if isinstance(trial, bool) or not isinstance(trial, int | np.integer):
            raise TypeError(f"{source}: trial = {trial!r}; expected a whole number")
        if not 0 <= trial < n_trials:
            raise ValueError(f"{source}: trial = {trial}; expected 0 to {n_trials - 1}")
        if is_one_axis(recording):
            raise ValueError(f"{source}: a recording of one axis cannot be drawn as an arm; expected one of two axes")
        chosen = recording.isel(trial=[int(trial)])
        label = {name: chosen[name].values[0] for name in TRIAL_COORDINATES if name in chosen.coords}
        body: dict[str, Any] = {name: float(label[name]) for name in BODY}
        for name, value in body.items():
            if not np.isfinite(value):
                raise ValueError(f"{source}: {name} of trial {trial} is {value}; expected the subject's, to draw it")
        shoulder = None
        if "shoulder_marker" in chosen:
            sections = signal.butter(2, min(MARKER_CUTOFF / (float(chosen.attrs["rate"]) / 2), 0.9), output="sos")
            marker = chosen["shoulder_marker"].values
            shoulder = signal.sosfiltfilt(sections, marker, axis=1, padlen=min(15, marker.shape[1] - 1))
        try:
            subject = replace(RELAX, **body)
            if "joint_angle" in chosen:
                angle = chosen["joint_angle"].values[0]
            else:
                angle = (start_posture(chosen)[:, None] + joint_rotations(chosen, shoulder=shoulder))[0]
        except ValueError as error:
            raise ValueError(f"{source}: trial {trial}: {error}") from None
        displacement = chosen["displacement"].values[0]
        title = [str(label["subject"]), str(label["condition"])]
        onset = float(label["pulse_onset"])
        if np.isfinite(onset):
            level = f" level {label['pulse_level']:g}" if label["pulse_level"] > 0 else ""  # 0 and NaN: no level
            title.append(f"pulse{level} at {label['pulse_direction']:g}°")
        limit = float(label["limit_time"])
        if np.isfinite(limit):
            title.append(f"limit at {limit:.2f} s")
        return cls(
            model=build_model(subject, strap=None if shoulder is None else Strap()),
            time=chosen["time"].values,
            qpos=np.hstack([*([] if shoulder is None else [shoulder[0]]), angle, displacement]),
            displacement=displacement,
            disturbance=chosen["perturbation"].values[0],
            reaction=chosen["force"].values[0],
            title=", ".join(part for part in title if part),
            pulse_onset=onset if np.isfinite(onset) else None,
            limit_time=limit if np.isfinite(limit) else None,
        )

    @property
    def duration(self) -> float:
        """Of the trial [s]; the last sample stands for its own step."""
        return float(self.time[-1] + self.time[1])

    @property
    def end(self) -> float:
        """Until when there is something to see [s]: the end of the trial, or the limit of the workspace before it."""
        return self.duration if self.limit_time is None else min(self.limit_time, self.duration)

    def between(self, start: float, stop: float) -> Self:
        """The part of the trial from `start` to `stop` [s]; all of it if fewer than two samples lie between them."""
        inside = (self.time >= start) & (self.time <= stop)
        if inside.sum() < 2:
            return self
        names = ("time", "qpos", "displacement", "disturbance", "reaction")
        return replace(self, **{name: getattr(self, name)[inside] for name in names})

    def at(self, values: Array, times: ArrayLike) -> Array:
        """Values of one of the signals at other times, linearly between samples, (..., column).

        Args:
          values: such as `qpos`, (time, column).
          times: [s], (...).
        """
        return np.stack([np.interp(np.asarray(times, dtype=float), self.time, column) for column in values.T], axis=-1)
