"""`armperturb calibrate`."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from armperturb.commands.command import Command
from armperturb.files import require_new
from armperturb.progress import Progress
from armperturb.subject import TASKS


@dataclass(frozen=True, kw_only=True)
class Calibrate(Command):
    """Find the average person around whom cohorts are drawn, from the published tables 2.1, F.2, F.3 and F.4."""

    needs_simulator = True

    out: Path
    """TOML file to write; the package's own is armperturb/average_person.toml."""
    laws: tuple[Literal["linear", "short-range", "full"], ...] = ("full",)
    """Muscle laws to calibrate; the person that is written is that of the full law, the others are for comparison."""
    seed: int = 0
    """Seed of the multisines."""
    multisines: int = 6
    """Sets of multisines and noise that the search sees; what a person fits of a single one is partly its chance."""
    iterations: int = 20
    """Largest number of steps of the search."""
    engine: Literal["mujoco", "compiled"] = "compiled"
    """What simulates the candidates: the compiled arm, or MuJoCo, which takes longer."""
    overwrite: bool = False
    """Replace an existing file."""

    def run(self) -> list[str]:
        """Calibrate, and write the average person."""
        from armperturb.study.experiments.calibration import calibrate, save_calibrations

        if "full" not in self.laws:
            raise ValueError(f"laws = {self.laws!r}; expected 'full' among them, as its person is written")
        require_new([self.out], overwrite=self.overwrite)
        searches = [(law, task) for law in dict.fromkeys(self.laws) for task in TASKS]
        calibrations = []
        with Progress("calibration", total=len(searches) * self.iterations, unit="steps") as bar:
            for number, (law, task) in enumerate(searches, start=1):

                def report_progress(line: str, name: str = f"{law}, {task}") -> None:
                    bar.write(f"{name}: {line}", file=sys.stderr)
                    bar.update()

                calibrations.append(
                    calibrate(
                        task,
                        law,
                        seed=self.seed,
                        n_multisines=self.multisines,
                        max_iterations=self.iterations,
                        engine=self.engine,
                        progress=report_progress,
                    )
                )
                bar.update(number * self.iterations - bar.n)
        save_calibrations(self.out, calibrations)
        lines = []
        for each in calibrations:
            said = each.describe()
            lines += [f"{each.law}, {each.task}, {line}" for line in (*said.facts, *said.remarks)]
            if not each.converged:
                lines[-1] += f" (--iterations {2 * self.iterations})"
        return [*lines, f"average person: {self.out}"]
