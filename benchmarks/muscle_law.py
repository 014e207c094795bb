"""What the full muscle law costs on top of the linear muscle: 64 trials.

Run `python -m benchmarks.muscle_law`. Both sides run in turns, as times on shared machines are noisy, and what counts
is their ratio; the target is at most 1.5.
"""

import statistics
from dataclasses import replace

from armperturb.envs.lab.experiment import run_experiment
from armperturb.muscle_law import MuscleLaw
from armperturb.subject import POSITION, RELAX
from benchmarks.simulation import in_turns, trials_of

LAW = MuscleLaw(
    short_range_stiffness=(8.0, 4.0, 6.0),
    elastic_limit_deg=0.5,
    elastic_limit_spread=0.5,
    elastic_limit_slope=0.01,
    loss_angle_deg=5.0,
    recovery_time=2.0,
    thinning_velocity=0.3,
    spindle_saturation=1.0,
    spindle_direction=0.3,
)
"""Every mechanism at once."""


def main() -> None:
    """Compare the full law with linear muscle."""
    # The preset's damping cannot thin: its shoulder group is negative.
    linear = (RELAX, replace(POSITION, b_s=POSITION.b_se))
    full = (replace(linear[0], muscle=LAW), replace(linear[1], muscle=LAW))
    times = in_turns(
        {
            name: lambda people=people: run_experiment(trials_of(people))
            for name, people in (("full", full), ("linear", linear))
        }
    )
    ratio = statistics.median(a / b for a, b in zip(times["full"], times["linear"], strict=True))
    print(f"full muscle law over linear muscle: {ratio:.2f}; target at most 1.5")


if __name__ == "__main__":
    main()
