"""Arm model structures: which parameters are estimated, within which bounds, and what the others are (table C.1)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any, NoReturn, Self

import numpy as np
from numpy.typing import ArrayLike

from armperturb.analysis.arm.parameters import PARAMETERS
from armperturb.arrays import Array
from armperturb.files import packaged_table
from armperturb.subject import TASKS, Subject
from armperturb.validation import require_one_of, require_type

Bounds = tuple[float, float]

PUBLISHED = packaged_table(__package__, "structures.toml")
"""Tables of the file beside this module."""
_DEFAULTS = {each.name: each.default for each in fields(Subject) if isinstance(each.default, float)}
GAINS = ("kv_", "kp_", "ka_", "kf_")
"""How the names of feedback gains begin."""
_AT_LEAST_ZERO = ("b_s", "b_e", "k_s", "k_e", "b_h")
_ABOVE_ZERO = ("m_h", "m_f", "k_h", "Td_s", "Td_e", "fact_s", "fact_e")


def unit(parameter: str) -> str:
    """SI unit of a parameter."""
    units = PUBLISHED["units"]
    return str(units.get(parameter) or units[parameter.partition("_")[0]])


def wide_bounds(parameter: str) -> tuple[float, float, float] | None:
    """Least, usual and greatest value that a human arm can have, SI; None of what is no parameter of an arm."""
    wide, quantity = PUBLISHED["wide"], parameter.partition("_")[0]
    values = wide.get(parameter) or (wide.get(quantity) if parameter in PARAMETERS else None)
    return None if values is None else (float(values[0]), float(values[1]), float(values[2]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Structure:
    """One arm model structure: what each parameter of an arm (`arm.parameters.PARAMETERS`) is in a fit.

    A parameter is free (has bounds and an initial value), tied to free ones, or fixed; one that is none of these has
    the value that a `Subject` has by default: no feedback, a delay of 30 ms, a cut-off of 3.5 Hz. Others are derived
    from the thesis's by `fixing`, `freeing`, `tying` and `named`:

        STRUCTURES["3"].fixing(Td_s=0.03, fact_s=3.5, fact_e=3.5).tying(Td_e={"Td_s": 1.0}).named("3, one delay")

    Attributes:
      name: as the thesis numbers it.
      bounds: lower and upper bound of each free parameter, SI. Names that are no parameter of an arm, as m_tot, exist
        through those that are tied to them.
      initial: value of each free parameter, SI; the default start of a fit, see `start_in`.
      fixed: task to the value of parameters that are not estimated, SI.
      tied: parameter to the free ones whose weighted sum it is: {"m_h": {"m_tot": 0.49}}.
      prior: free parameter to mean and standard deviation of what is known of it beside the trials, SI: a normal
        distribution, which maximum likelihood estimates take into account.
      mixing: derivative of an arm's parameters by the free ones, (arm parameter, free parameter); follows from these.

    Raises:
      TypeError: name is no text.
      ValueError: a name is unknown, a parameter is free, tied or fixed at the same time, or missing, ties form a
        circle, bounds cross or hold values that no arm can have, an initial value is missing or outside its bounds, or
        a prior has no width or a mean outside the bounds.
    """

    name: str
    bounds: Mapping[str, Bounds]
    initial: Mapping[str, float]
    fixed: Mapping[str, Mapping[str, float]]
    tied: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    prior: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    mixing: Array = field(init=False, repr=False)
    _constant: Mapping[str, Array] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        require_type("Structure: name", self.name, str, "a text")
        self._check_names()
        self._check_values()
        mixing = np.zeros((len(PARAMETERS), len(self.free)))
        for index, name in enumerate(PARAMETERS):
            for driver, share in self.tied.get(name, {name: 1.0} if name in self.bounds else {}).items():
                mixing[index, self.free.index(driver)] = share
        constant = {
            task: np.array(
                [
                    0.0 if name in self.bounds or name in self.tied else values.get(name, _DEFAULTS.get(name, math.nan))
                    for name in PARAMETERS
                ]
            )
            for task, values in self.fixed.items()
        }
        object.__setattr__(self, "mixing", mixing)
        object.__setattr__(self, "_constant", constant)

    def _fail(self, message: str) -> NoReturn:
        raise ValueError(f"model {self.name}: {message}")

    def _check_names(self) -> None:
        tied_to = {driver for shares in self.tied.values() for driver in shares}
        for task in self.fixed:
            if task not in TASKS:
                self._fail(f"fixed values for the task {task!r}; expected {', '.join(TASKS)}")
        for task in TASKS:
            if task not in self.fixed:
                self._fail(f"no fixed values for the task {task}; expected a mapping, which may be empty")
        for name in self.bounds:
            if name not in PARAMETERS and name not in tied_to:
                self._fail(f"free parameter {name!r} is unknown; expected one of {', '.join(PARAMETERS)}")
        for name in self.initial:
            if name not in self.bounds:
                self._fail(f"initial value of {name!r}, which is not free; expected {', '.join(self.bounds)}")
        for name, shares in self.tied.items():
            if name not in PARAMETERS:
                self._fail(f"tied parameter {name!r} is unknown; expected one of {', '.join(PARAMETERS)}")
            if name in self.bounds:
                self._fail(f"{name} is both free and tied; expected one of them")
            self._check_circle(name)
            for driver, share in shares.items():
                if driver not in self.bounds:
                    self._fail(f"{name} is tied to {driver!r}, which is not free; expected {', '.join(self.bounds)}")
                if not math.isfinite(share):
                    self._fail(f"{name} is tied to {share!r} times {driver}; expected a finite number")
        for task, values in self.fixed.items():
            for name in values:
                if name not in PARAMETERS:
                    self._fail(f"fixed parameter {name!r} is unknown; expected one of {', '.join(PARAMETERS)}")
                if name in self.bounds or name in self.tied:
                    kind = "free" if name in self.bounds else "tied"
                    self._fail(f"{name} is both {kind} and fixed ({task}); expected one of them")
            for name in PARAMETERS:
                if not (name in self.bounds or name in self.tied or name in values or name in _DEFAULTS):
                    self._fail(f"{name} is neither free nor tied nor fixed ({task}); expected one of them")

    def _check_circle(self, name: str) -> None:
        way = [name]
        while (driver := next((each for each in self.tied.get(way[-1], ()) if each in self.tied), None)) not in way:
            if driver is None:
                return
            way.append(driver)
        self._fail(f"ties in a circle: {' to '.join([*way, driver])}; expected one of them free or fixed")

    def _check_values(self) -> None:
        if not self.bounds:
            self._fail("no parameter is free; expected at least one")
        for name, pair in self.bounds.items():
            lower, upper = pair
            if not (math.isfinite(lower) and math.isfinite(upper) and lower < upper):
                self._fail(f"bounds of {name} = {lower!r} to {upper!r}; expected a lower and a higher finite number")
            least = 0.0 if name in _AT_LEAST_ZERO or name in _ABOVE_ZERO else -math.inf
            if lower < least or (lower == least and name in _ABOVE_ZERO):
                word = "above" if name in _ABOVE_ZERO else "at least"
                self._fail(f"bounds of {name} = {lower!r} to {upper!r}; expected a lower bound {word} 0")
            if name not in self.initial:
                self._fail(f"no initial value for {name}; expected {lower:g} to {upper:g}")
            if not lower <= self.initial[name] <= upper:
                self._fail(f"initial value of {name} = {self.initial[name]!r}; expected {lower:g} to {upper:g}")
        for task, values in self.fixed.items():
            for name, value in values.items():
                if not math.isfinite(value) and (name, value) != ("k_h", math.inf):
                    self._fail(f"{name} = {value!r} is fixed ({task}); expected a finite number")
        for name, (mean, sd) in self.prior.items():
            if name not in self.bounds:
                self._fail(f"prior of {name!r}, which is not free; expected one of {', '.join(self.bounds)}")
            lower, upper = self.bounds[name]
            if not (math.isfinite(sd) and sd > 0.0):
                self._fail(f"prior of {name} = {mean!r} +- {sd!r}; expected a width above 0")
            if not lower <= mean <= upper:
                self._fail(f"prior of {name} = {mean!r} +- {sd!r}; expected a mean of {lower:g} to {upper:g}")

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the estimated parameters; `m_tot` stands for both masses (eqs 2.14, 2.15)."""
        return tuple(self.bounds)

    def constant(self, task: str) -> Array:
        """Parameters of an arm whose free parameters are zero, in the order of `arm.parameters.PARAMETERS`, SI.

        Args:
          task: "PT" or "RT", for the fixed values.
        """
        return self._constant[task]

    def parameters(self, task: str, values: ArrayLike) -> Array:
        """All parameters of an arm, in the order of `arm.parameters.PARAMETERS`, SI.

        Args:
          task: "PT" or "RT", for the fixed values.
          values: of the free parameters, (parameter,).
        """
        return self._constant[task] + self.mixing @ np.asarray(values, dtype=float)

    def arm(self, body: Subject, values: ArrayLike) -> Subject:
        """The arm with these free parameters.

        Args:
          body: gives task, segments and posture.
          values: of the free parameters, (parameter,).
        """
        parameters: dict[str, Any] = dict(zip(PARAMETERS, self.parameters(body.task, values).tolist(), strict=True))
        return replace(body, **parameters)

    def named(self, name: str) -> Self:
        """The same structure under another name."""
        return replace(self, name=name)

    def fixing(self, **values: float) -> Self:
        """The structure in which parameters have these values in every task instead of being free or tied.

        What is tied to a parameter that gets fixed is fixed with it.

        Raises:
          ValueError: a name is unknown, a value is not finite, or something is tied to it and to another that is free.
        """
        bounds = {name: pair for name, pair in self.bounds.items() if name not in values}
        tied = {name: shares for name, shares in self.tied.items() if name not in values}
        follow = {}
        for name, shares in list(tied.items()):
            if shares.keys() & values.keys():
                if not shares.keys() <= values.keys():
                    self._fail(f"{name} is tied to {', '.join(shares)}; expected all of them fixed, or none")
                follow[name] = sum(share * values[driver] for driver, share in tied.pop(name).items())
        physical = {name: value for name, value in values.items() if name in PARAMETERS or name not in self.bounds}
        return replace(
            self,
            name=f"{self.name} variant",
            bounds=bounds,
            initial={name: value for name, value in self.initial.items() if name in bounds},
            fixed={task: {**fixed, **physical, **follow} for task, fixed in self.fixed.items()},
            tied=tied,
            prior={name: known for name, known in self.prior.items() if name in bounds},
        )

    def freeing(self, **free: tuple[float, float, float]) -> Self:
        """The structure in which these parameters are estimated.

        Args:
          **free: name to lower bound, initial value and upper bound, SI. A name that is free already gets these.

        Raises:
          ValueError: as the class.
        """
        return replace(
            self,
            name=f"{self.name} variant",
            bounds={**self.bounds, **{name: (lower, upper) for name, (lower, _, upper) in free.items()}},
            initial={**self.initial, **{name: initial for name, (_, initial, _) in free.items()}},
            fixed=self._fixed_without(free),
            tied={name: shares for name, shares in self.tied.items() if name not in free},
        )

    def tying(self, **tied: Mapping[str, float]) -> Self:
        """The structure in which each of these parameters is a weighted sum of free ones.

        Args:
          **tied: name to the free parameters and their weights, e.g. Td_e={"Td_s": 1.0}.

        Raises:
          ValueError: as the class.
        """
        return replace(
            self,
            name=f"{self.name} variant",
            bounds={name: pair for name, pair in self.bounds.items() if name not in tied},
            initial={name: value for name, value in self.initial.items() if name not in tied},
            fixed=self._fixed_without(tied),
            tied={**self.tied, **tied},
            prior={name: known for name, known in self.prior.items() if name not in tied},
        )

    def knowing(self, **prior: tuple[float, float]) -> Self:
        """The structure in which these free parameters are known beside the trials.

        Args:
          **prior: name to mean and standard deviation, SI.

        Raises:
          ValueError: as the class.
        """
        return replace(self, name=f"{self.name} variant", prior={**self.prior, **prior})

    def widened(self) -> Self:
        """The same structure within the bounds of what a human arm can have.

        Feedback gains that may not be negative stay so: that is what the structure says, not how far it looks.
        """
        wide = {}
        for name, (lower, upper) in self.bounds.items():
            least, _, most = wide_bounds(name) or (lower, 0.0, upper)
            is_positive = name.startswith(GAINS) and lower >= 0.0
            wide[name] = (lower if is_positive else least, most)
        return replace(self, bounds=wide)

    def _fixed_without(self, names: Mapping[str, Any]) -> dict[str, dict[str, float]]:
        return {
            task: {name: value for name, value in values.items() if name not in names}
            for task, values in self.fixed.items()
        }


def _published(name: str) -> Structure:
    """A structure of the file beside this module."""
    table = PUBLISHED["structures"][name]
    return Structure(
        name=name,
        bounds={parameter: (lower, upper) for parameter, (lower, _, upper) in table["free"].items()},
        initial={parameter: initial for parameter, (_, initial, _) in table["free"].items()},
        fixed={task: table.get("fixed", {}).get(task, {}) for task in TASKS},
        tied=table.get("tied", {}),
    )


MODEL_3_WIDE = _published("3 (D.2)")
"""Model 3 with the bounds of table D.2."""

STRUCTURES = MappingProxyType({name: _published(name) for name in PUBLISHED["structures"] if name != MODEL_3_WIDE.name})
"""Structures by name. 1 to 6 are those of table C.1: intrinsic and grip (1), with velocity (2), velocity and position
(3) feedback, and with force (4), acceleration (5) or both (6) beside these. 3a and 3b are those of appendix E: total
mass, velocity and position feedback, with (3a) and without (3b) negative gains; grip, delay and cut-off fixed."""


def structure_of(model: Structure | str, *, wide: bool = False) -> Structure:
    """A structure, or the one of that name.

    Args:
      model: a structure, or its name.
      wide: whether bounds that are those of the thesis give way to those of `Structure.widened`; other bounds stay.

    Raises:
      ValueError: there is none of that name.
    """
    if isinstance(model, str):
        require_one_of("structure", "model", model, list(STRUCTURES))
        model = STRUCTURES[model]
    if not wide:
        return model
    of_thesis = {each for structure in STRUCTURES.values() for each in structure.bounds.items()}
    wider = {name: pair for name, pair in model.widened().bounds.items() if (name, model.bounds[name]) in of_thesis}
    return replace(model, bounds={**model.bounds, **wider})


def is_published(structure: Structure) -> bool:
    """Whether a structure is one of `STRUCTURES`, or one of these `Structure.widened`, whatever it is called."""

    def content(of: Structure) -> tuple[object, ...]:
        return of.bounds, of.initial, of.fixed, of.tied, of.prior

    return any(content(structure) in (content(each), content(each.widened())) for each in STRUCTURES.values())


def published_starts(appendix: str, structure: Structure) -> Mapping[str, Mapping[str, float]]:
    """Name of each start of an appendix to its initial values, SI.

    Args:
      appendix: "D" or "E".
      structure: whose free parameters the file lists.
    """
    starts = PUBLISHED["starts"][appendix].items()
    return MappingProxyType({name: dict(zip(structure.free, values, strict=True)) for name, values in starts})


def neutral_start(structure: Structure, task: str) -> dict[str, float]:
    """Where a search begins that is not to know what feedback it will find, SI.

    Masses, damping, stiffness and grip are those of model 1 in the task (tables C.3 and C.13), feedback gains are zero,
    delays and cut-offs in the middle of their bounds. All are moved into the bounds.

    Args:
      structure: whose free parameters get values.
      task: "PT" or "RT".

    Raises:
      ValueError: the task is unknown.
    """
    require_one_of("neutral_start", "task", task, TASKS)
    intrinsic = PUBLISHED["starts"]["C"][task]
    intrinsic = {**intrinsic, "m_tot": intrinsic["m_h"] + intrinsic["m_f"]}
    start = {}
    for name, (lower, upper) in structure.bounds.items():
        unknown = 0.0 if name.startswith(GAINS) else 0.5 * (lower + upper)
        start[name] = min(max(intrinsic.get(name, unknown), lower), upper)
    return start


def start_in(structure: Structure, task: str) -> Mapping[str, float]:
    """The structure's initial values, or where these are the thesis's for the other task, the neutral ones, SI.

    The published initial values of model 1 are those of the relax task, and those of all others of the position task.

    Args:
      structure: any.
      task: "PT" or "RT".
    """
    published = STRUCTURES.get(structure.name)
    is_published = published is not None and dict(structure.initial) == dict(published.initial)
    if is_published and task != ("RT" if structure.name == "1" else "PT"):
        return neutral_start(structure, task)
    return structure.initial
