"""What all trials of an experiment share, and what truly happens in them before any instrument reads it."""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from types import NoneType
from typing import TypeVar

import numpy as np
from scipy import signal

from armperturb.arrays import Array
from armperturb.environment import ENGINES, TIMESTEP, Environment, Strap
from armperturb.envs.lab.emg import Emg
from armperturb.envs.lab.instruments import Instruments
from armperturb.perturbations import Perturbation
from armperturb.validation import require_number, require_one_of, require_type

T = TypeVar("T")

Progress = Callable[[float], object]
"""Called with the simulated seconds, of all trials together, since the last call."""


NOTHING = 1e-30
"""Smaller values are rounded to zero: what dies away would end in denormal numbers, which are slow and pack badly."""


@dataclass(frozen=True, kw_only=True)
class Setup:
    """The laboratory of an experiment; fields as the arguments of `run_experiment`, and `owner`, whose they are.

    Raises:
      TypeError: a value has the wrong type.
      ValueError: a value is out of its range, or values do not go together.
    """

    environment: Environment = field(default_factory=Environment)
    timestep: float = TIMESTEP
    rate: float = 200.0
    rope: str = "ideal"
    strap: Strap | None = None
    engine: str = "mujoco"
    linear: bool = False
    instruments: Instruments | None = None
    owner: str = "run_experiment"

    def __post_init__(self) -> None:
        owner = self.owner
        require_type(f"{owner}: environment", self.environment, Environment, "Environment or None")
        require_type(f"{owner}: linear", self.linear, (bool, np.bool_), "True or False")
        require_type(f"{owner}: instruments", self.instruments, (Instruments, NoneType), "Instruments or None")
        require_type(f"{owner}: strap", self.strap, (Strap, NoneType), "Strap or None")
        require_number(owner, "timestep", self.timestep, above=0.0)
        require_number(owner, "rate", self.rate, above=0.0)
        if self.decimation < 1 or abs(self.decimation * self.rate * self.timestep - 1.0) > 1e-9:
            fitting = 1.0 / (self.rate * max(1, math.ceil(1.0 / (self.rate * self.timestep))))
            raise ValueError(
                f"{owner}: rate = {self.rate!r} Hz; expected the simulation's {1 / self.timestep:g} Hz over a whole "
                f"number (the option timestep = {fitting:.12g} goes with this rate)"
            )
        if self.linear and self.rope != "ideal":
            raise ValueError(f"{owner}: rope = {self.rope!r}; expected 'ideal', the only one that the linear arm has")
        if self.linear and self.strap is not None:
            raise ValueError(f"{owner}: strap = {self.strap!r}; expected None, as the linear arm's shoulder is fixed")
        require_one_of(owner, "engine", self.engine, ENGINES)
        if self.engine == "compiled" and (self.rope != "ideal" or self.strap is not None):
            name, value = ("rope", self.rope) if self.rope != "ideal" else ("strap", self.strap)
            raise ValueError(
                f"{owner}: {name} = {value!r} with engine = 'compiled'; expected engine = 'mujoco', as the compiled "
                "arm has an ideal rope and a shoulder that is held in place"
            )

    @property
    def decimation(self) -> int:
        """Simulation steps in a sample of the recording."""
        return round(1.0 / (self.rate * self.timestep))

    @property
    def lowpass(self) -> Array | None:
        """The filter in front of the recorder as second-order sections at the simulation's rate; None for none."""
        return self.instruments.lowpass(self.timestep, self.rate) if self.instruments else None

    @property
    def emg(self) -> Emg | None:
        """Amplifier of the muscles' signals, if there is one."""
        return self.instruments.emg if self.instruments else None

    @property
    def emg_lead(self) -> float:
        """Delay of the recorder's filter at low frequencies, which the EMG does not pass [s]."""
        if self.lowpass is None:
            return 0.0
        # Group delay at zero frequency of each section: that of the numerator less that of the denominator.
        b, a = self.lowpass[:, :3], self.lowpass[:, 3:]
        order = np.arange(3)
        steps = (b @ order) / b.sum(axis=1) - (a @ order) / a.sum(axis=1)
        return float(steps.sum() * self.timestep)

    def sampled(self, signals: Array, rest: Array | float = 0.0) -> Array:
        """What reaches the instruments of signals at the simulation's rate, (time, signal).

        Args:
          signals: (step, signal).
          rest: their values before the trial, where the filter starts, (signal,).
        """
        if self.lowpass is not None:
            signals = signal.sosfilt(self.lowpass, signals - rest, axis=0) + rest
        return flushed(signals[:: self.decimation])

    def n_samples(self, perturbations: Sequence[Perturbation]) -> int:
        """Samples of the recording in the longest of these."""
        return max(round(each.duration / (self.timestep * self.decimation)) for each in perturbations)


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """Signals of trials at the recording's rate, behind the anti-alias filter but before the instruments' errors.

    Attributes:
      perturbation: disturbance d [N], (trial, time, axis).
      force: f that the handle exerts on the hand [N], (trial, time, axis).
      displacement: of the handle [m], (trial, time, axis).
      joint_angle: [rad], (trial, time, joint).
      shoulder: displacement of the shoulder [m], (trial, time, axis); None where it is held in place.
      excitation: of the reflexes [Nm], unfiltered, as no recorder sees it, (trial, time, joint); of no samples where no
        EMG is recorded.
      limit_time: when the handle reached the limit of the workspace [s], nan where it never did, (trial,).
    """

    perturbation: Array
    force: Array
    displacement: Array
    joint_angle: Array
    shoulder: Array | None = None
    excitation: Array
    limit_time: Array


def in_threads(function: Callable[[int], T], n_calls: int, n_threads: int) -> Iterator[T]:
    """Results in order of `function(0)`, `function(1)` and so on, which spend their time in NumPy and SciPy."""
    with ThreadPoolExecutor(n_threads) as pool:
        yield from pool.map(function, range(n_calls))


def flushed(values: Array) -> Array:
    """The same values, with zeros for those that are nothing."""
    return np.where(np.abs(values) < NOTHING, 0.0, values)
