"""The laboratory around any arm in MJCF: handle, grip, manipulator, perturbation and instruments."""

import copy
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from armperturb.arrays import Array
from armperturb.environment import TIMESTEP, Environment
from armperturb.envs.lab.experiment import perturbation_labels, read_instruments
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.posture import (
    holding_activation,
    lock_joints,
    muscles_of,
    scalar_joints,
)
from armperturb.envs.lab.settling import require_slow, require_stable, settle
from armperturb.envs.lab.setup import Setup, Truth, in_threads
from armperturb.envs.lab.simulation import silent_simulator
from armperturb.envs.lab.start import (
    in_posture,
    leaves_plane,
    require_hand,
    require_joints,
    site_of_hand,
    start_of,
    take_controls,
)
from armperturb.envs.lab.stepping import DIVERGED
from armperturb.envs.lab.stretch_reflex import Controller
from armperturb.envs.lab.two_segments import Segments, segments_of
from armperturb.models.rig import AHEAD, SLIDES, STRAIN_GAUGE, start_motors
from armperturb.models.scene import PREFIX, PUSHES, Grip, in_laboratory, load_arm, require_forces
from armperturb.perturbations import Perturbation, check_bandwidth
from armperturb.perturbations.perturbation import MAX_DURATION
from armperturb.recording import make_recording
from armperturb.subject import RELAX, TASKS
from armperturb.validation import LONGEST_NAME, require_number, require_one_of


@dataclass(frozen=True, kw_only=True, eq=False)
class Rest:
    """How the arm is at rest before each trial.

    Attributes:
      posture: joint of the model to its position [rad or m].
      activation: muscle to its constant activation [-].
      force: of the handle on the hand [N], (axis,). The manipulator bears it: it is the constant part of the
        perturbation and of the recorded force.
      settled: time that the arm took to find its rest, with the hand on the handle that was held [s]; 0 where the
        posture is one of rest.
      segments: lengths and angles of the arm as a recording has them.
    """

    posture: Mapping[str, float]
    activation: Mapping[str, float]
    force: Array
    settled: float
    segments: Segments

    def summary(self) -> str:
        """In words."""
        push = float(np.hypot(*self.force))
        lines = [
            f"rest: {'at once' if not self.settled else f'after {self.settled:.3g} s'}, {push:.3g} N on the handle"
        ]
        if self.activation:
            values = np.array([*self.activation.values()])
            lines.append(
                f"muscles: {len(values)}, activation {values.mean():.3g} on average, at most {values.max():.3g}"
            )
        arm = self.segments
        if np.isfinite(arm.l_h):
            side = " (a left arm, recorded as in a mirror)" if arm.is_left else ""
            lines.append(
                f"arm: {arm.l_h:.3g} and {arm.l_f:.3g} m, shoulder at {arm.theta_s_deg:.3g} and elbow at "
                f"{arm.theta_e_deg:.3g} deg{side}"
            )
        if arm.refused:
            lines.append(f"arm: {arm.refused}")
        return "\n".join(lines)


class Laboratory:
    """Handle, grip, manipulator, perturbation and instruments around an arm in MJCF.

    The arm takes a posture and finds its rest: its hand grips the handle, which is held, and velocities are braked
    until nothing moves any more. The force that the handle then exerts is borne by the manipulator in all trials, as
    the constant part of perturbation and force. Weights do not act unless `gravity` is set: a rope carries the arm, as
    in the thesis. A hand that can leave the plane of the handle is held at its height by the grip, with the same
    stiffness and damping; handles turn freely in hands.

    Attributes:
      model: of arm and manipulator, whose parts have names that begin with "lab/".
      rest: how the arm is at rest.
    """

    def __init__(
        self,
        model: str | Path | mujoco.MjSpec,
        hand_site: str,
        *,
        environment: Environment | None = None,
        activation: float | None = None,
        controller: Controller | None = None,
        posture_deg: Mapping[str, float] | None = None,
        keyframe: str | None = None,
        locked: Sequence[str] = (),
        joints: tuple[str, str] | None = None,
        handle: Sequence[float] | None = None,
        turn_deg: float = 0.0,
        gravity: bool = False,
        k_h: float = RELAX.k_h,
        b_h: float = RELAX.b_h,
        timestep: float = TIMESTEP,
    ) -> None:
        """Build the laboratory and let the arm come to rest.

        Args:
          model: an MJCF file, "myo_sim:NAME" for a model of the package myo-sim, or a specification.
          hand_site: site in the middle of the grip, or a body whose origin is there.
          environment: what the hand holds; by default the thesis's manipulator.
          activation: of the muscles [-], 0 to 1: the level from which theirs differ as little as holding the posture
            asks for. None leaves controls as the keyframe or the model has them.
          controller: what acts at each step beside constant activations, such as `StretchReflex`.
          posture_deg: hinge to angle [deg]; other joints are as in the keyframe or the model, or where equality
            constraints ask them to be. A joint without a name is called by its place, "joint0" for the first.
          keyframe: of the model, whose posture, controls and activations are taken.
          locked: joints that the cuffs hold in this posture; "*" in a name stands for any text.
          joints: names of shoulder and elbow, if other joints than two hinges about the vertical move the hand.
          handle: where the handle starts, in the world of the model [m], x, y and z; None for at the hand. Joints move
            to reach it.
          turn_deg: of the handle's x axis (right) from the model's about the vertical [deg]; y is forward.
          gravity: whether weights act.
          k_h: stiffness of the grip [N/m], > 0.
          b_h: damping of the grip [Ns/m], >= 0.
          timestep: of the simulation [s].

        Raises:
          TypeError: a value has the wrong type.
          ValueError: the model cannot be read, disables forces, or has no such site, joint, keyframe or muscles; the
            hand cannot reach the handle; the arm finds no rest, or one that is unstable without a controller; or a
            value is out of its range.
          OSError: the file cannot be read.
        """
        owner = "Laboratory"
        require_number(owner, "turn_deg", turn_deg)
        require_number(owner, "b_h", b_h, at_least=0.0)
        for name, value in (("timestep", timestep), ("k_h", k_h)):
            require_number(owner, name, value, above=0.0)
        for field, names in (("locked", locked), ("joints", joints)):
            if isinstance(names, str):
                raise TypeError(f"{owner}: {field} = {names!r}; expected several names, e.g. {(names,)!r}")
        if joints is not None and len(joints) != 2:
            raise ValueError(f"{owner}: joints = {joints!r}; expected two names, those of shoulder and elbow")
        if activation is not None:
            require_number(owner, "activation", activation, at_least=0.0, at_most=1.0)
        self.environment, self.timestep, self._controller = environment or Environment(), timestep, controller
        self.name, self.activation = _name_of(model), activation
        with silent_simulator():
            spec = load_arm(model)
        if not gravity:
            spec.option.gravity = np.zeros(3)
        require_forces(spec)
        require_hand(spec, hand_site)
        start, controls = start_of(spec, posture_deg or {}, keyframe)
        spec = lock_joints(spec, locked, start) if locked else spec
        require_joints(spec, joints or (), "joints")
        hand = site_of_hand(spec, hand_site)
        place = None if handle is None else np.array(handle, dtype=float)
        if place is not None and place.shape != (3,):
            raise ValueError(f"{owner}: handle = {handle!r}; expected three numbers, x, y and z [m]")
        arm, data = in_posture(spec, hand, start, posture_deg or {}, place)
        take_controls(arm, data, controls)
        muscles = muscles_of(arm)
        if activation is not None:
            if not len(muscles):
                raise ValueError(
                    f"{owner}: activation = {activation!r} for a model without muscles; expected actuators of type "
                    "muscle, or no activation"
                )
            holding_activation(arm, data, activation)
        site, turn = arm.site(hand).id, np.radians(turn_deg)
        grip = Grip(stiffness=k_h, damping=b_h, upright=leaves_plane(arm, data, site))
        place = data.site_xpos[site].copy() if place is None else place
        self.model = in_laboratory(spec, hand, self.environment, grip, place, turn, timestep).compile()
        self._data = mujoco.MjData(self.model)
        self._data.qpos[: arm.nq], self._data.ctrl[: arm.nu], self._data.act[: arm.na] = data.qpos, data.ctrl, data.act
        self._slides = np.array([self.model.joint(PREFIX + name).qposadr[0] for name in SLIDES])
        self._gauge = int(self.model.sensor(PREFIX + STRAIN_GAUGE).adr[0])
        self._push = self.model.actuator(PREFIX + PUSHES[0]).id
        slides = np.array([self.model.joint(PREFIX + name).dofadr[0] for name in SLIDES])
        require_slow(self.model, self._data, slides)
        with silent_simulator():
            settled = settle(self.model, self._data, self._slides, slides, self._gauge)
        if controller is None:  # the poles with one are not known
            require_stable(self.model, self._data, slides, settled.force)
        segments = segments_of(self.model, self._data, self.model.site(hand).id, turn, joints)
        self.rest = Rest(
            posture={arm.joint(j).name: float(self._data.qpos[arm.jnt_qposadr[j]]) for j in scalar_joints(arm)},
            activation={arm.actuator(i).name: float(data.ctrl[i]) for i in muscles},
            force=settled.force,
            settled=settled.time,
            segments=segments,
        )

    def record(
        self,
        perturbations: Sequence[Perturbation],
        *,
        condition: str = "",
        task: str = "PT",
        seed: int = 0,
        rate: float = 200.0,
        instruments: Instruments | None = None,
        n_threads: int = 0,
    ) -> xr.Dataset:
        """Perturb the arm, each time from rest, and return what was recorded.

        Args:
          perturbations: one for each trial.
          condition: name of the condition; by default the activation, or "passive".
          task: that the recording names, "PT" or "RT".
          seed: of the instruments' noise in the first trial; the others have the next ones.
          rate: of the recording [Hz]; a whole number of simulation steps must fit into a sample.
          instruments: what the signals pass on their way; None records the truth. There is no EMG.
          n_threads: 0 takes all cores; the recording does not depend on it.

        Returns:
          A recording (see `armperturb.recording`) with `perturbation`, `force`, `displacement`, the marker of a
          shoulder that does not move if the instruments film it, and `joint_angle` if the arm moves by two hinges in
          the plane. Lengths and angles of the arm are nan where nothing says which joints are shoulder and elbow.

        Raises:
          ValueError: no perturbations, one with content above 45 % of the simulation rate, or rates that do not fit.
          RuntimeError: a trial could not be integrated.
        """
        require_one_of("Laboratory", "task", task, TASKS)
        if not perturbations:
            raise ValueError("Laboratory: perturbations is empty; expected at least one")
        instruments = replace(instruments, emg=None) if instruments is not None else None
        setup = Setup(
            environment=self.environment,
            timestep=self.timestep,
            rate=rate,
            instruments=instruments,
            owner="Laboratory",
        )
        for perturbation in perturbations:
            check_bandwidth(perturbation, 1.0 / self.timestep)
            name = f"duration of a {type(perturbation).__name__}"
            require_number("Laboratory", name, perturbation.duration, at_least=2.0 / rate, at_most=MAX_DURATION)
        n_samples = setup.n_samples(perturbations)
        n_threads = n_threads or os.cpu_count() or 1
        logs = [*in_threads(lambda i: self._trial(perturbations[i], setup, n_samples), len(perturbations), n_threads)]
        push, log, limit_time = (np.stack(parts) for parts in zip(*logs, strict=True))
        truth = Truth(
            perturbation=push,
            displacement=log[..., :2],
            force=log[..., 2:4],
            joint_angle=log[..., 4:],
            excitation=log[:, :0, :2],
            limit_time=limit_time,
        )
        signals = {name: getattr(truth, name) for name in ("perturbation", "force", "displacement", "joint_angle")}
        if not self.rest.segments.hinges:
            del signals["joint_angle"]
        if instruments is not None:
            signals |= read_instruments([seed + i for i in range(len(perturbations))], instruments, truth)
        labels = self._labels(perturbations, task, condition)
        return make_recording(signals, labels | {"limit_time": limit_time}, rate)

    def _labels(self, perturbations: Sequence[Perturbation], task: str, condition: str) -> dict[str, ArrayLike]:
        n, arm = len(perturbations), self.rest.segments
        condition = condition or ("passive" if self.activation is None else f"activation {self.activation:g}")
        same: dict[str, str | float] = {"subject": self.name, "task": task, "condition": condition, "pulse_level": 0.0}
        same |= {name: getattr(arm, name) for name in ("l_h", "l_f", "theta_s_deg", "theta_e_deg")}
        labels: dict[str, ArrayLike] = {name: np.full(n, value) for name, value in same.items()}
        pulses = {name: np.asarray(values) for name, values in perturbation_labels(perturbations).items()}
        if arm.is_left:
            pulses["pulse_direction"] = (180.0 - pulses["pulse_direction"]) % 360.0
        return labels | pulses | {"repetition": range(n), "order": range(n)}

    def _trial(self, perturbation: Perturbation, setup: Setup, n_samples: int) -> tuple[Array, Array, float]:
        """Perturbation, log (displacement, force, angles) and time of the limit, at the recording's rate."""
        model, data = self.model, copy.copy(self._data)
        n_steps, timestep = n_samples * setup.decimation, self.timestep
        push = perturbation.sample(1.0 / timestep, n_steps + AHEAD + 1, -timestep)
        known = push + self.rest.force
        start_motors(model, data, self._push, known[: AHEAD + 1])
        arm = self.rest.segments
        columns, ctrl, gauge = [*self._slides, *arm.hinges], data.ctrl, data.sensordata[self._gauge : self._gauge + 2]
        motors = slice(self._push, self._push + 2)
        log, force = np.empty((n_steps, len(columns))), np.empty((n_steps, 2))
        with silent_simulator():
            act = self._controller(model, data) if self._controller else None
            for step in range(n_steps):
                log[step] = data.qpos[columns]
                if act is not None:
                    act()
                ctrl[motors] = known[step + AHEAD + 1]
                mujoco.mj_step(model, data)
                force[step] = gauge
        farthest = np.abs(log[:: setup.decimation, :2]).max(axis=1)
        reached = np.flatnonzero(~(farthest < self.environment.workspace))
        if any(data.warning[warning].number for warning in DIVERGED):
            raise RuntimeError(
                f"Laboratory: the arm of {self.name} could not be integrated; expected finite motion (a smaller "
                "timestep, a softer grip, or a weaker perturbation)"
            )
        limit_time = reached[0] * setup.decimation * timestep if len(reached) else np.nan
        angle = log[:, 2:] * np.array(arm.signs) + np.array(arm.offsets)
        mirror = np.array([-1.0 if arm.is_left else 1.0, 1.0])
        signals = np.concatenate([log[:, :2] * mirror, force * mirror, angle], axis=1)
        held = self.rest.force * mirror
        rest = np.concatenate([np.zeros(2), held, np.radians([arm.theta_s_deg, arm.theta_e_deg])[: angle.shape[1]]])
        return setup.sampled(known[1 : n_steps + 1] * mirror, held), setup.sampled(signals, rest), limit_time


def _name_of(model: str | Path | mujoco.MjSpec) -> str:
    """What a recording calls the arm."""
    name = model.modelname if isinstance(model, mujoco.MjSpec) else Path(str(model).replace(":", "/")).stem
    return name[:LONGEST_NAME].strip() or "arm"
