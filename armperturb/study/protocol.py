"""The conditions that are run (thesis 2.5, table 2.1)."""

from dataclasses import dataclass

import numpy as np

from armperturb.envs.experiment import Trial
from armperturb.perturbations import Multisine, MultisineThenPulse
from armperturb.perturbations.pulse import PULSE_DIRECTIONS_DEG
from armperturb.subject import Subject

PULSE_UNIT = 53.9
"""Peak force of pulse level 1 [N]: mean over subjects of ten times the RMS force of PT7.5 (table 2.1)."""

TAIL = 4.0
"""Time from the onset of the pulse to the end of a trial [s]."""


@dataclass(frozen=True, kw_only=True)
class Condition:
    """One row of table 2.1.

    Attributes:
      name: task and intended RMS displacement [mm].
      preset: who the subjects are drawn around, "position" or "relax".
      rms_force: of the multisine, per axis [N].
      pulse_levels: multiples of `PULSE_UNIT`; each is applied in both directions.
      repetitions: of every pulse level and direction.
      model: structure that is fitted, see `armperturb.analysis.structures`.
    """

    name: str
    preset: str
    rms_force: float
    pulse_levels: tuple[int, ...]
    repetitions: int
    model: str

    def n_trials(self) -> int:
        """Trials per subject."""
        return len(self.pulse_levels) * len(PULSE_DIRECTIONS_DEG) * self.repetitions


CONDITIONS = (
    Condition(name="PT7.5", preset="position", rms_force=5.4, pulse_levels=(1, 2), repetitions=2, model="3b"),
    Condition(name="RT7.5", preset="relax", rms_force=0.9, pulse_levels=(1,), repetitions=2, model="1"),
)


def draw_multisines(condition: Condition, seed: int) -> list[Multisine]:
    """A different realisation for each trial of a condition, the same for all subjects."""
    key = CONDITIONS.index(condition)
    return [
        Multisine.draw(seed=np.random.default_rng([seed, key, trial]), rms=condition.rms_force)
        for trial in range(condition.n_trials())
    ]


def trials_of(condition: Condition, subject: Subject, multisines: list[Multisine], seed: int) -> list[Trial]:
    """The trials of one subject in one condition.

    Args:
      condition: what is run.
      subject: who is perturbed.
      multisines: one per trial.
      seed: of the instruments' noise, different for every subject and condition.
    """
    cells = [
        (repetition, level, direction)
        for repetition in range(condition.repetitions)
        for level in condition.pulse_levels
        for direction in PULSE_DIRECTIONS_DEG
    ]
    return [
        Trial(
            subject=subject,
            perturbation=MultisineThenPulse.join(
                multisine, peak=level * PULSE_UNIT, direction_deg=direction, tail=TAIL
            ),
            condition=condition.name,
            repetition=repetition,
            pulse_level=level,
            seed=int(np.random.SeedSequence([seed, number]).generate_state(1)[0]),
        )
        for number, ((repetition, level, direction), multisine) in enumerate(zip(cells, multisines, strict=True))
    ]
