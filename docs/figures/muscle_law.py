"""What does the muscle law do in the experiments of the textbooks?

Run `python docs/figures/muscle_law.py PICTURE.png`. It stretches one muscle element by hand, without an arm around it.
"""

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from armperturb.controllers.arm_control import stretched
from armperturb.controllers.compiled import spindle_velocity
from armperturb.muscle_law import MuscleLaw
from armperturb.subject import RELAX

DT = 1e-3
LAW = MuscleLaw(short_range_stiffness=10.0, elastic_limit_deg=0.7, elastic_limit_spread=0.5)
WORN = replace(LAW, loss_angle_deg=5.0, recovery_time=2.0)


def torque_of(law: MuscleLaw, stretch_deg: np.ndarray) -> np.ndarray:
    """Short-range torque of the shoulder element over an imposed stretch [Nm], (time,)."""
    motion = np.zeros((len(stretch_deg), 1, 3))
    motion[:, 0, 0] = np.radians(stretch_deg)
    torque, _ = stretched([replace(RELAX, muscle=law)], motion, np.gradient(motion, DT, axis=0), DT)
    return torque[:, 0, 0]


def ramps(axes: Axes) -> None:
    ramp = np.minimum(10.0 * np.arange(0.0, 0.6, DT), 5.0)
    for spread in (0.0, 0.5, 1.0):
        axes.plot(ramp, torque_of(replace(LAW, elastic_limit_spread=spread), ramp), label=f"spread {spread:g}")
    axes.set(title="Ramp and hold: two phases", xlabel="stretch [deg]", ylabel="torque [Nm]", xlim=(0, 4))


def speeds(axes: Axes) -> None:
    law = replace(LAW, elastic_limit_deg=0.1, elastic_limit_slope=0.02)
    for speed in (20.0, 74.5, 186.2):
        ramp = speed * np.arange(0.0, 7.0 / speed, DT)
        axes.plot(ramp, torque_of(law, ramp), label=f"{speed:g} deg/s")
    axes.set(title="Elastic limit grows with speed", xlabel="stretch [deg]", ylabel="torque [Nm]")


def history(axes: Axes) -> None:
    movement = 5.0 * np.sin(2 * np.pi * np.arange(0.0, 3.0, DT))
    ramp = 10.0 * np.arange(0.0, 0.2, DT)
    for label, before in (
        ("rested", np.zeros(1)),
        ("after movement", np.append(movement, np.zeros(50))),
        ("2 s later", np.append(movement, np.zeros(2000))),
        ("10 s later", np.append(movement, np.zeros(10000))),
    ):
        torque = torque_of(WORN, np.append(before, ramp))[len(before) - 1 :]
        axes.plot(np.append(0.0, ramp), torque - torque[0], label=label)
    axes.set(
        title="Thixotropy: movement, then rest", xlabel="stretch [deg]", ylabel="torque gained [Nm]", xlim=(0, 3.4)
    )


def loops(axes: Axes) -> None:
    for amplitude in (0.3, 1.0, 3.0):
        stretch = amplitude * np.sin(2 * np.pi * np.arange(0.0, 3.0, DT))
        axes.plot(stretch[1000:], torque_of(LAW, stretch)[1000:], label=f"{amplitude:g} deg")
    axes.set(title="Cycles: hysteresis", xlabel="stretch [deg]", ylabel="torque [Nm]", xlim=(-3.4, 6))


def damping(axes: Axes) -> None:
    speed = np.linspace(0.0, 1.0, 201)
    for thinning in (math.inf, 0.3, 0.06):
        subject = replace(RELAX, muscle=MuscleLaw(thinning_velocity=thinning))
        motion = np.repeat(speed[:, None, None], 3, axis=2)
        beside_linear, _ = stretched([subject], np.zeros_like(motion), motion, DT)
        axes.plot(speed, subject.b_se * speed + beside_linear[:, 0, 1], label=f"{thinning:g} rad/s")
    axes.set(title="Shear-thinning damping", xlabel="velocity [rad/s]", ylabel="torque [Nm]", ylim=(0, 1))


def spindles(axes: Axes) -> None:
    speed = np.linspace(-1.0, 1.0, 401)
    for label, saturation, direction in (("linear", math.inf, 0.0), ("saturating", 0.3, 0.0), ("one way", 0.3, 1.0)):
        axes.plot(speed, [spindle_velocity(v, saturation, direction, 0.0) for v in speed], label=label)
    axes.set(title="Velocity response of spindles", xlabel="velocity [rad/s]", ylabel="answered [rad/s]", ylim=(-1, 1))


def main(path: Path) -> None:
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    panels: list[Callable[[Axes], None]] = [ramps, speeds, history, loops, damping, spindles]
    for axes, panel in zip(figure.subplots(2, 3).flat, panels, strict=True):
        panel(axes)
        axes.legend(frameon=False)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=80)
    print(f"wrote {path}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "muscle_law.png"))
