"""`armperturb simulate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from armperturb.commands.command import Command
from armperturb.files import require_folder_of, require_new


@dataclass(frozen=True, kw_only=True)
class Simulate(Command):
    """Perturb one synthetic person and write the recording."""

    needs_simulator = True

    subject: Path
    """TOML file of the person."""
    perturbation: Path
    """CSV file with the columns time_s,d_x_N,d_y_N."""
    out: Path
    """Recording to write (netCDF4)."""
    ideal: bool = False
    """Record the true signals: no instrument effects, no noise."""
    rope: Literal["ideal", "pendulum"] = "ideal"
    """Whether the rope that carries the arm pulls it back like a pendulum."""
    rate: float = 200.0
    """Sampling rate of the recording [Hz]."""
    seed: int = 0
    """Seed of the instruments' noise."""
    overwrite: bool = False
    """Replace an existing recording; an input is never replaced."""

    def run(self) -> list[str]:
        """Simulate the trial and write the recording."""
        import numpy as np

        from armperturb.environment import Environment
        from armperturb.envs.lab.experiment import run_experiment
        from armperturb.envs.lab.instruments import Instruments
        from armperturb.envs.lab.trial import Trial
        from armperturb.perturbations import load_perturbation
        from armperturb.recording import save_recording
        from armperturb.subject import Subject

        person, perturbation = Subject.load(self.subject), load_perturbation(self.perturbation)
        require_folder_of(self.out)
        require_new([self.out], overwrite=self.overwrite)
        environment = Environment()
        try:
            recording = run_experiment(
                [Trial(subject=person, perturbation=perturbation, seed=self.seed)],
                environment,
                rate=self.rate,
                rope=self.rope,
                instruments=None if self.ideal else Instruments(),
            )
        except (ValueError, RuntimeError) as error:
            raise type(error)(f"{self.subject} with {self.perturbation}: {error}") from None
        limit = float(recording["limit_time"].values[0])
        if np.isfinite(limit):
            raise ValueError(
                f"{self.perturbation}: displacement reached the workspace limit at {limit:.3f} s; expected it to stay "
                f"within {environment.workspace:g} m of the start (a weaker perturbation or a stiffer subject)"
            )
        save_recording(recording, self.out)
        return [f"recording: {self.out}"]
