"""`armperturb joint`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from armperturb.commands.command import Command
from armperturb.files import require_new
from armperturb.validation import require_number


@dataclass(frozen=True, kw_only=True)
class Joint(Command):
    """Perturb one joint of a synthetic person on a servo and write the recording."""

    needs_simulator = True

    out: Path
    """Recording of one axis to write (netCDF4), NAME.nc."""
    person: str = "ankle"
    """Preset ankle, wrist or elbow, or FILE.toml of a person with one joint."""
    servo: Literal["position", "force"] = "position"
    """What the device does: impose the movement, or be a virtual environment that a random torque perturbs."""
    threshold: float | None = None
    """Speed of stretch above which spindles respond [rad/s], to stretch alone; by default the person's own reflex."""
    level: float = 1.0
    """Level of contraction, as a multiple of the person's own."""
    duration: float = 60.0
    """Of each trial [s]."""
    trials: int = 1
    """How many trials, each with a perturbation and noise of its own."""
    size: float | None = None
    """RMS velocity that a position servo imposes [rad/s], or RMS torque of a force servo [Nm]; by default 0.34 rad/s,
    or what moves the joint's intrinsic stiffness by 0.03 rad."""
    signal_to_noise: float | None = None
    """Power of the response to the perturbation over that of the person's noise [dB], on a position servo of torques,
    on a force servo of angles; by default no noise."""
    rate: float = 1000.0
    """Sampling rate of the recording [Hz]; a whole number of steps of 0.5 ms must fit into a sample."""
    seed: int = 0
    """Seed of perturbations and noise."""
    overwrite: bool = False
    """Replace an existing recording; an input is never replaced."""

    def run(self) -> list[str]:
        """Simulate the trials and write the recording."""
        from armperturb.analysis.joint.signals import LEAST_RATE
        from armperturb.envs.lab.joint_experiment import JointTrial, at_signal_to_noise, run_joint_experiment
        from armperturb.joint_person import JOINT_PEOPLE, JointPerson, half_wave, servo_of
        from armperturb.perturbations.one_axis import RECORDED_SPEED, imposed_movement, random_noise
        from armperturb.recording_files import require_ending, save_recording
        from armperturb.validation import require_one_of

        require_number("joint", "duration", self.duration, at_least=1.0, at_most=3600.0)
        require_number("joint", "trials", self.trials, at_least=1, at_most=1000, whole=True)
        require_number("joint", "level", self.level, at_least=0.0)
        require_number("joint", "rate", self.rate, at_least=LEAST_RATE)
        require_number("joint", "seed", self.seed, at_least=0, whole=True)
        require_number("joint", "signal_to_noise", self.signal_to_noise, at_least=-100.0, at_most=200.0, optional=True)
        require_ending(self.out)
        require_new([self.out], overwrite=self.overwrite)
        if self.person.endswith(".toml"):
            person = JointPerson.load(self.person)
        else:
            require_one_of("joint", "person", self.person, (*JOINT_PEOPLE, "FILE.toml"))
            person = JOINT_PEOPLE[self.person]
        if self.threshold is not None:
            person = half_wave(person, self.threshold)
        person, servo = person.at_level(self.level), servo_of(person.joint, self.servo)
        trials = []
        for i in range(self.trials):
            seed = 1000 * self.seed + i
            if self.servo == "position":
                speed = RECORDED_SPEED if self.size is None else self.size
                perturbation = imposed_movement(
                    speed=speed,
                    seed=seed,
                    duration=self.duration,
                    rate=self.rate,
                    natural_frequency=person.natural_frequency,
                )
            else:
                rms = 0.03 * person.stiffness if self.size is None else self.size
                perturbation = random_noise(rms=rms, seed=seed, duration=self.duration, rate=self.rate)
            trial = JointTrial(person=person, perturbation=perturbation, seed=seed, repetition=i)
            if self.signal_to_noise is not None:
                trial = at_signal_to_noise(trial, servo, self.signal_to_noise, rate=self.rate)
            trials.append(trial)
        save_recording(run_joint_experiment(trials, servo, rate=self.rate), self.out)
        return [f"recording: {self.out}"]
