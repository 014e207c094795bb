"""What the full muscle law costs on top of the linear muscle: 320 trials at 1 ms.

Run `python -m benchmarks.muscle_law`. Both sides run in turns, as times on shared machines are noisy, and what counts
is their ratio; the target is at most 1.5.
"""

import os
import statistics
from dataclasses import replace

from armperturb.muscle_law import MuscleLaw
from armperturb.subject import POSITION, RELAX
from benchmarks.batch_overhead import DURATION, N_TRIALS, REPEATS, TIMESTEP, experiment, seconds

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
    """Print the microseconds per trial and step of both, and their ratio."""
    # The preset's damping cannot thin: its shoulder group is negative.
    linear = (RELAX, replace(POSITION, b_s=POSITION.b_se))
    sides = {
        "linear muscle": experiment(linear),
        "full law": experiment((replace(linear[0], muscle=LAW), replace(linear[1], muscle=LAW))),
    }
    for function in sides.values():
        function()  # warm-up
    times: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(REPEATS):
        for name, function in sides.items():
            times[name].append(seconds(function))
    per_step = N_TRIALS * DURATION / TIMESTEP
    for name, values in times.items():
        print(f"{name:>14}: {1e6 * statistics.median(values) / per_step:6.2f} us per trial and step")
    ratios = [b / a for a, b in zip(*times.values(), strict=True)]
    print(
        f"{N_TRIALS} trials at {1e3 * TIMESTEP:g} ms on {os.cpu_count()} cores: ratio {statistics.median(ratios):.2f} "
        f"({min(ratios):.2f} to {max(ratios):.2f}); target at most 1.5"
    )


if __name__ == "__main__":
    main()
