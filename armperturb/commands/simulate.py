"""`armperturb simulate`."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from armperturb.commands.command import Command
from armperturb.environment import TIMESTEP, Environment
from armperturb.files import checksum, require_new

if TYPE_CHECKING:
    import xarray as xr

    from armperturb.envs.lab.instruments import Instruments
    from armperturb.perturbations import Perturbation

OF_A_MODEL = (
    *("hand", "activation", "reflex", "posture_deg", "keyframe", "lock", "joints", "handle", "turn_deg", "gravity"),
    "task",
)
"""Options that go with --mjcf only."""

ELBOW = (0.0, 150.0)
"""Angles between which a person's elbow bends, straight at zero [deg]."""


@dataclass(frozen=True, kw_only=True)
class Simulate(Command):
    """Perturb one synthetic person, or any arm in MJCF, and write the recording."""

    needs_simulator = True

    subject: Path | None = None
    """TOML file of the person."""
    perturbation: Path
    """CSV file with the columns time_s,d_x_N,d_y_N."""
    out: Path
    """Recording to write (netCDF4), NAME.nc."""
    ideal: bool = False
    """Record the true signals: no instrument effects, no noise."""
    manipulator: tuple[float, float, float] = (Environment.m_env, Environment.b_env, Environment.k_env)
    """Mass [kg], damping [Ns/m] and stiffness [N/m] of the manipulator, as identify prints them; by default the
    thesis's."""
    rope: Literal["ideal", "pendulum"] = "ideal"
    """Whether the rope that carries the arm pulls it back like a pendulum."""
    rate: float = 200.0
    """Sampling rate of the recording [Hz]; a sample has to be a whole number of steps of the simulation."""
    timestep: float = TIMESTEP
    """Step of the simulation [s]; a fast perturbation, or a high rate, needs a short step."""
    seed: int = 0
    """Seed of the instruments' noise."""
    mjcf: Path | None = None
    """Model of another arm, in the place of --subject: an MJCF file, or myo_sim:NAME for one of the package myo-sim.
    The options that follow go with it."""
    hand: str | None = None
    """Site of the model in the middle of the grip, or a body whose origin is there."""
    activation: float | None = None
    """Level of the muscles' co-contraction, 0 to 1; each differs from it as little as holding the posture asks for."""
    reflex: tuple[float, float, float] | None = None
    """Stretch reflexes of the muscles: excitation per relative stretch, per relative speed [s], and delay [s]."""
    posture_deg: tuple[str, ...] = ()
    """Start posture, as JOINT=ANGLE [deg] of each hinge that is not where the model has it."""
    keyframe: str | None = None
    """Keyframe of the model to start from."""
    lock: tuple[str, ...] = ()
    """Joints that cuffs hold in the start posture; * stands for any text."""
    joints: tuple[str, str] | None = None
    """Shoulder and elbow, if other joints than two hinges about the vertical move the hand; identify needs them."""
    handle: tuple[float, float, float] | None = None
    """Where the handle starts, in the model's world [m]; by default at the hand."""
    turn_deg: float = 0.0
    """Of the handle's x axis (right) from the model's, about the vertical [deg]."""
    gravity: bool = False
    """Let weights act; by default a rope carries the arm."""
    task: Literal["PT", "RT"] = "PT"
    """Task that the recording names."""
    checksum: bool = False
    """Print the SHA-256 of the recording, in a line as `sha256sum -c` reads it."""
    overwrite: bool = False
    """Replace an existing recording; an input is never replaced."""

    def run(self) -> list[str]:
        """Simulate the trial and write the recording."""
        import numpy as np

        from armperturb.envs.lab.instruments import Instruments
        from armperturb.perturbations import load_perturbation
        from armperturb.recording_files import require_ending, save_recording

        self._require_one_arm()
        perturbation = load_perturbation(self.perturbation)
        require_ending(self.out)
        require_new([self.out], overwrite=self.overwrite)
        instruments = None if self.ideal else Instruments()
        if instruments and instruments.antialias and self.rate <= 2.0 * instruments.antialias:
            raise ValueError(
                f"simulate: rate = {self.rate:g} Hz; expected above {2.0 * instruments.antialias:g} Hz, as a filter of "
                f"{instruments.antialias:g} Hz precedes the recorder (--ideal records without it)"
            )
        m_env, b_env, k_env = self.manipulator
        environment = Environment(m_env=m_env, b_env=b_env, k_env=k_env)
        arm = self.mjcf or self.subject
        try:
            record = self._of_subject if self.mjcf is None else self._of_model
            recording, lines = record(perturbation, environment, instruments)
        except (ValueError, RuntimeError) as error:
            raise type(error)(f"{arm} with {self.perturbation}: {error}") from None
        limit = float(recording["limit_time"].values[0])
        if np.isfinite(limit):
            raise ValueError(
                f"{self.perturbation}: displacement reached the workspace limit at {limit:.3f} s; expected it to stay "
                f"within {environment.workspace:g} m of the start (a weaker perturbation, a stiffer arm or "
                "weaker reflexes)"
            )
        save_recording(recording, self.out)
        sums = [f"{checksum(self.out)}  {self.out}"] if self.checksum else []
        return [*lines, f"recording: {self.out}", *sums]

    def _require_one_arm(self) -> None:
        """Refuse two arms, none, and options of the other one.

        Raises:
          ValueError: there are any.
        """
        if (self.subject is None) == (self.mjcf is None):
            raise ValueError("simulate: expected either --subject FILE or --mjcf FILE")
        if self.mjcf is not None and self.hand is None:
            raise ValueError("simulate: hand = None; expected --hand SITE with --mjcf")
        if self.mjcf is not None and self.rope != "ideal":
            raise ValueError(f"simulate: rope = {self.rope!r} with --mjcf; expected 'ideal'")
        for field in fields(self):
            if self.mjcf is None and field.name in OF_A_MODEL and getattr(self, field.name) != field.default:
                option = field.name.replace("_", "-")
                raise ValueError(f"simulate: --{option} without --mjcf; expected it with a model in MJCF only")

    def _of_subject(
        self, perturbation: "Perturbation", environment: Environment, instruments: "Instruments | None"
    ) -> tuple["xr.Dataset", list[str]]:
        import numpy as np

        from armperturb.envs.lab.experiment import run_experiment
        from armperturb.envs.lab.trial import Trial
        from armperturb.subject import Subject

        assert self.subject is not None
        trial = Trial(subject=Subject.load(self.subject), perturbation=perturbation, seed=self.seed)
        recording = run_experiment(
            [trial], environment, timestep=self.timestep, rate=self.rate, rope=self.rope, instruments=instruments
        )
        low, high = np.degrees(recording["joint_angle"].sel(joint="elbow").quantile([0.0, 1.0]).values).tolist()
        if ELBOW[0] <= low and high <= ELBOW[1]:
            return recording, []
        return recording, [
            f"the elbow was bent from {low:.1f} to {high:.1f} deg, where a person's moves from {ELBOW[0]:g} to about "
            f"{ELBOW[1]:g} deg; joints of synthetic people have no limits"
        ]

    def _of_model(
        self, perturbation: "Perturbation", environment: Environment, instruments: "Instruments | None"
    ) -> tuple["xr.Dataset", list[str]]:
        from armperturb.envs.lab.laboratory import Laboratory
        from armperturb.envs.lab.stretch_reflex import StretchReflex

        assert self.mjcf is not None
        assert self.hand is not None
        reflex = None
        if self.reflex is not None:
            length, velocity, delay = self.reflex
            reflex = StretchReflex(length=length, velocity=velocity, delay=delay)
        laboratory = Laboratory(
            str(self.mjcf),
            self.hand,
            environment=environment,
            activation=self.activation,
            controller=reflex,
            posture_deg=_angles(self.posture_deg),
            keyframe=self.keyframe,
            locked=self.lock,
            joints=self.joints,
            handle=self.handle,
            turn_deg=self.turn_deg,
            gravity=self.gravity,
            timestep=self.timestep,
        )
        recording = laboratory.record(
            [perturbation], task=self.task, seed=self.seed, rate=self.rate, instruments=instruments
        )
        return recording, laboratory.rest.summary().splitlines()


def _angles(texts: tuple[str, ...]) -> Mapping[str, float]:
    """Joint to angle [deg] of options.

    Raises:
      ValueError: a text is something else, or a joint is named twice.
    """
    angles: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name in angles:
            raise ValueError(f"simulate: posture-deg has {name!r} twice; expected each joint once")
        try:
            angles[name] = float(value)
        except ValueError:
            raise ValueError(f"simulate: posture-deg = {text!r}; expected JOINT=ANGLE in degrees") from None
    return angles
