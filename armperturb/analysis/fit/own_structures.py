"""Structures of one's own: from a TOML file, from options on top of a named structure, or from three choices.

A structure file is

    base = "3"                     # a named structure, within wide bounds; without it the file says all
    name = "3, one delay, rigid grip"
    [free]                         # bounds, or lower bound, initial value and upper bound, or "wide"
    Td_s = [0.01, 0.08]
    zeta_act = "wide"
    [fixed]                        # in both tasks; [fixed.PT] and [fixed.RT] are for one
    k_h = "rigid"
    [tied]                         # weighted sums of free parameters
    Td_e = { Td_s = 1.0 }
    [prior]                        # mean and standard deviation of what is known beside the trials
    m_f = [1.8, 0.3]
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import tomli_w

from armperturb.analysis.arm.geometry import mass_matrix
from armperturb.analysis.arm.parameters import GROUPS, PARAMETERS
from armperturb.analysis.fit.structures import STRUCTURES, Structure, structure_of, wide_bounds
from armperturb.anthropometry import Sex, Source, anthropometric_body
from armperturb.files import read_toml, write_whole
from armperturb.subject import HUMERUS_MASS_SHARE, TASKS, Subject
from armperturb.validation import require_keys, require_one_of, require_type

Range = tuple[float, float | None, float] | None
"""Lower bound, initial value (None to choose one) and upper bound; or None for those of `wide_bounds`."""

Inertia = Literal["tied", "points", "free"]
Grip = Literal["rigid", "spring"]
Reflex = Literal["none", "velocity", "position"]

TABLE_ERROR = 0.15
"""Error of a person's segment inertia as tables have it, over its value [-]: some 10 to 20 % between methods and
people; assumed."""

RIGID = "rigid"
"""What a grip stiffness without end is called in files and options."""


def composed(*, inertia: Inertia = "free", grip: Grip = "spring", reflex: Reflex = "none") -> Structure:
    """A structure from three choices, within wide bounds and from usual values.

    Args:
      inertia: "tied" (total mass, shared between two points in the middle of the segments as in the thesis), "points"
        (two masses there), or "free" (three numbers of the joint inertia).
      grip: "rigid", or "spring" with a damper.
      reflex: "none", "velocity", or "position" (velocity and position); with delay and cut-off of each joint and the
        damping ratio of the activation free.

    Raises:
      ValueError: a choice is unknown.
    """
    for field, value, known in (("inertia", inertia, Inertia), ("grip", grip, Grip), ("reflex", reflex, Reflex)):
        require_one_of("composed", field, value, get_args(known))
    masses = {"tied": ("m_tot",), "points": ("m_h", "m_f"), "free": ("i_s", "i_se", "i_e")}[inertia]
    quantities = ("b", "k", *{"none": (), "velocity": ("kv",), "position": ("kv", "kp")}[reflex])
    free = [*masses, *(name for quantity in quantities for name in _names(quantity))]
    free += ["b_h", "k_h"] if grip == "spring" else []
    free += [] if reflex == "none" else [*_names("Td"), *_names("fact"), "zeta_act"]
    tied = {"m_h": {"m_tot": HUMERUS_MASS_SHARE}, "m_f": {"m_tot": 1.0 - HUMERUS_MASS_SHARE}}
    fixed = ({"m_h": 0.0, "m_f": 0.0} if inertia == "free" else {}) | ({"k_h": math.inf} if grip == "rigid" else {})
    return edited(
        None,
        name=f"inertia {inertia}, grip {grip}, reflex {reflex}",
        free=dict.fromkeys(free),
        fixed=dict.fromkeys(TASKS, fixed),
        tied=tied if inertia == "tied" else {},
    )


def inertia_prior(
    body: Subject,
    sex: Sex,
    height: float,
    mass: float,
    source: Source = "de Leva",
    *,
    attached: float = 0.0,
    share: float = TABLE_ERROR,
) -> dict[str, tuple[float, float]]:
    """What tables tell of a person's joint inertia, for `Structure.knowing` where i_s, i_se and i_e are free.

    Args:
      body: posture and segment lengths, as `ConditionTrials.body`.
      sex: see `anthropometry.anthropometric_body`, also for the next four.
      height: [m].
      mass: of the whole body [kg].
      source: of the tables.
      attached: mass of cuff and handle that moves with the hand [kg].
      share: standard deviation over the value, of the coupling over the geometric mean of both joints' [-].

    Raises:
      ValueError: as `anthropometric_body`.
    """
    table = anthropometric_body(sex, height, mass, source, attached=attached)
    segments: dict[str, Any] = {name: value for name, value in table.items() if name not in ("l_h", "l_f")}
    (s, se), (_, e) = mass_matrix(replace(body, i_s=0.0, i_se=0.0, i_e=0.0, **segments)).tolist()
    return {"i_s": (s, share * s), "i_se": (se, share * math.sqrt(s * e)), "i_e": (e, share * e)}


def edited(
    base: Structure | None,
    *,
    name: str,
    free: Mapping[str, Range] | None = None,
    fixed: Mapping[str, Mapping[str, float]] | None = None,
    tied: Mapping[str, Mapping[str, float]] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
) -> Structure:
    """A structure with changes, which are made together; a rigid grip loses its damping.

    Args:
      base: what is changed; None to start from nothing.
      name: of the new structure.
      free: parameters to estimate.
      fixed: task to the values of parameters that are not estimated, SI.
      tied: parameter to the free ones whose weighted sum it is.
      prior: free parameter to its mean and standard deviation, SI.

    Raises:
      ValueError: a parameter is asked to be two things, has no bounds, or as `Structure`.
    """
    free, tied, prior = free or {}, tied or {}, prior or {}
    given = {task: _with_grip((fixed or {}).get(task, {})) for task in TASKS}
    kinds = {
        "free": free,
        "tied": tied,
        "fixed": {each: value for values in given.values() for each, value in values.items()},
    }
    for kind, other in (("free", "tied"), ("free", "fixed"), ("tied", "fixed")):
        if both := [each for each in kinds[kind] if each in kinds[other]]:
            raise ValueError(f"model {name}: {both[0]} is both {kind} and {other}; expected one of them")
    alike = {each: value for each, value in given["PT"].items() if given["RT"].get(each) == value}
    start = base
    if base is not None and alike:
        # What is tied to them follows, and they need not be parameters of an arm.
        start = base.fixing(**alike)
        given = {task: {each: values[each] for each in values if each not in alike} for task, values in given.items()}
    dropped = {*tied, *given["PT"], *given["RT"]}
    gone = {*free, *dropped}
    ranges = {each: _range(name, start, each, asked) for each, asked in free.items()}

    def remaining(table: Mapping[str, Any]) -> dict[str, Any]:
        return {each: value for each, value in table.items() if each not in gone}

    return Structure(
        name=name,
        bounds={
            **(remaining(start.bounds) if start else {}),
            **{each: (low, high) for each, (low, _, high) in ranges.items()},
        },
        initial={
            **(remaining(start.initial) if start else {}),
            **{each: first for each, (_, first, _) in ranges.items()},
        },
        fixed={task: {**(remaining(start.fixed[task]) if start else {}), **given[task]} for task in TASKS},
        tied={**(remaining(start.tied) if start else {}), **tied},
        prior={
            **{each: known for each, known in (start.prior if start else {}).items() if each not in dropped},
            **prior,
        },
    )


def with_options(
    base: Structure,
    *,
    free: Sequence[str] = (),
    fix: Sequence[str] = (),
    bounds: Sequence[str] = (),
    tie: Sequence[str] = (),
    prior: Sequence[str] = (),
) -> Structure:
    """A structure with the changes that options of the command line ask for.

    The name of a quantity, as Td or k, stands for its parameters of all joints.

    Args:
      base: what is changed.
      free: "NAME" (within wide bounds), "NAME=LOWER:UPPER" or "NAME=LOWER:INITIAL:UPPER".
      fix: "NAME=VALUE"; "k_h=rigid" for a rigid grip.
      bounds: "NAME=LOWER:UPPER", of free parameters.
      tie: "NAME=WEIGHT*NAME", with + between several; a weight of one may be left out.
      prior: "NAME=MEAN+-SD".

    Raises:
      ValueError: an option is no such text, names a parameter that is not free, or as `edited`.
    """
    if not any((free, fix, bounds, tie, prior)):
        return base
    changes = [f"{kind} {text}" for kind, texts in (("free", free), ("fix", fix), ("bounds", bounds)) for text in texts]
    changes += [f"{kind} {text}" for kind, texts in (("tie", tie), ("prior", prior)) for text in texts]
    name = f"{base.name} with {', '.join(changes)}"
    fixed = {each: value for text in fix for each, value in _fixed_option(text).items()}
    changed = edited(
        base,
        name=name,
        free={each: asked for text in free for each, asked in _free_option(text).items()},
        fixed=dict.fromkeys(TASKS, fixed),
        tied=dict(map(_tie_option, tie)),
    )
    asked = {each: limits for text in bounds for each, limits in _bounds_option(text, changed).items()}
    known = {each: values for text in prior for each, values in _prior_option(text).items()}
    return edited(changed, name=name, free=asked, prior=known)


def load_structure(path: str | Path) -> Structure:
    """Read a structure from a TOML file, which the head of this module describes.

    Raises:
      ValueError: the file is no TOML, or a key or value is refused.
      OSError: the file cannot be read.
    """
    table = read_toml(path, 'base = "3"')
    require_keys(str(path), table, ("base", "name", "free", "fixed", "tied", "prior"))
    try:
        base = table.get("base")
        if base is not None:
            require_one_of("structure", "base", base, list(STRUCTURES))
        parts = {key: _table(key, table.get(key, {})) for key in ("free", "fixed", "tied", "prior")}
        in_both = {key: value for key, value in parts["fixed"].items() if key not in TASKS}
        by_task = {task: _table(f"fixed.{task}", parts["fixed"].get(task, {})) for task in TASKS}
        return edited(
            base and structure_of(base, wide=True),
            name=str(table.get("name", Path(path).stem)),
            free={name: _range_of(name, value) for name, value in parts["free"].items()},
            fixed={
                task: {name: _value_of(name, value) for name, value in {**in_both, **by_task[task]}.items()}
                for task in TASKS
            },
            tied={
                name: {
                    driver: _number(f"tied: {name}: {driver}", weight)
                    for driver, weight in _table(f"tied: {name}", shares).items()
                }
                for name, shares in parts["tied"].items()
            },
            prior={name: _prior_of(name, value) for name, value in parts["prior"].items()},
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def save_structure(structure: Structure, path: str | Path) -> None:
    """Write a structure to a TOML file that `load_structure` reads back exactly; it needs no base.

    Raises:
      TypeError: structure is no `Structure`.
      OSError: the file cannot be written.
    """
    require_type("structure", structure, Structure, "a Structure, e.g. of load_structure or STRUCTURES")
    table = {
        "name": structure.name,
        "free": {name: [lower, structure.initial[name], upper] for name, (lower, upper) in structure.bounds.items()},
        "fixed": {task: dict(values) for task, values in structure.fixed.items()},
        "tied": {name: dict(shares) for name, shares in structure.tied.items()},
        "prior": {name: list(known) for name, known in structure.prior.items()},
    }
    write_whole(path, tomli_w.dumps(table))


def _names(quantity: str) -> tuple[str, ...]:
    """Parameters of a quantity; other names stand for themselves."""
    if quantity in GROUPS and quantity != "grip":
        return PARAMETERS[GROUPS[quantity]]
    return (quantity,)


def _with_grip(values: Mapping[str, float]) -> dict[str, float]:
    return {"b_h": 0.0, **values} if values.get("k_h") == math.inf else dict(values)


def _range(model: str, start: Structure | None, name: str, asked: Range) -> tuple[float, float, float]:
    """Bounds with an initial value: the one given, or what the structure or people usually have, if that is inside."""
    wide = wide_bounds(name)
    if asked is None and wide is None:
        raise ValueError(
            f"model {model}: free parameter {name!r} is unknown; expected one of {', '.join(PARAMETERS)}, or bounds of "
            "a new one that others are tied to"
        )
    lower, initial, upper = asked or wide or (0.0, None, 0.0)
    if initial is None:
        tables = () if start is None else (start.initial, *start.fixed.values())
        before = [values.get(name) for values in tables]
        usual = [value for value in (*before, wide and wide[1]) if value is not None and lower <= value <= upper]
        initial = usual[0] if usual else 0.5 * (lower + upper)
    return lower, initial, upper


def _number(what: str, value: object) -> float:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise ValueError(f"{what} = {value!r}; expected a number")
    return float(value)


def _parsed(what: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{what} = {text!r}; expected a number") from None


def _table(what: str, value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{what} = {value!r}; expected a table")
    return value


def _value_of(name: str, value: object) -> float:
    if name == "k_h" and value == RIGID:
        return math.inf
    return _number(f"fixed: {name}", value)


def _range_of(name: str, value: object) -> Range:
    if value == "wide":
        return None
    if not isinstance(value, list) or len(value) not in (2, 3):
        raise ValueError(f'free: {name} = {value!r}; expected [lower, upper], [lower, initial, upper] or "wide"')
    lower, *initial, upper = (_number(f"free: {name}", each) for each in value)
    return lower, initial[0] if initial else None, upper


def _prior_of(name: str, value: object) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError(f"prior: {name} = {value!r}; expected [mean, standard deviation]")
    return _number(f"prior: {name}", value[0]), _number(f"prior: {name}", value[1])


def _parted(option: str, text: str, expected: str) -> tuple[str, str]:
    """Name and the rest of "NAME=REST"."""
    name, equals, rest = (part.strip() for part in text.partition("="))
    if not (name and equals and rest):
        raise ValueError(f"{option} {text!r}; expected {expected}")
    return name, rest


def _free_option(text: str) -> dict[str, Range]:
    if "=" not in text:
        return dict.fromkeys(_names(text.strip()))
    expected = "NAME, NAME=LOWER:UPPER or NAME=LOWER:INITIAL:UPPER"
    name, rest = _parted("free", text, expected)
    values = [_parsed(f"free {name}", part) for part in rest.split(":")]
    if len(values) not in (2, 3):
        raise ValueError(f"free {text!r}; expected {expected}")
    return dict.fromkeys(_names(name), (values[0], values[1] if len(values) == 3 else None, values[-1]))


def _fixed_option(text: str) -> dict[str, float]:
    name, rest = _parted("fix", text, "NAME=VALUE, or k_h=rigid")
    value = math.inf if (name, rest) == ("k_h", RIGID) else _parsed(f"fix {name}", rest)
    return dict.fromkeys(_names(name), value)


def _bounds_option(text: str, structure: Structure) -> dict[str, Range]:
    name, rest = _parted("bounds", text, "NAME=LOWER:UPPER")
    values = [_parsed(f"bounds {name}", part) for part in rest.split(":")]
    if len(values) != 2:
        raise ValueError(f"bounds {text!r}; expected NAME=LOWER:UPPER")
    names = [each for each in _names(name) if each in structure.bounds]
    if not names:
        raise ValueError(
            f"bounds {text!r}, but {name} is not free; expected one of {', '.join(structure.free)} (--free adds some)"
        )
    return dict.fromkeys(names, (values[0], None, values[1]))


def _tie_option(text: str) -> tuple[str, dict[str, float]]:
    expected = "NAME=NAME or NAME=WEIGHT*NAME, with + between several"
    name, rest = _parted("tie", text, expected)
    shares: dict[str, float] = {}
    for term in rest.split("+"):
        weight, star, driver = (part.strip() for part in term.rpartition("*"))
        if not driver or bool(star) != bool(weight):
            raise ValueError(f"tie {text!r}; expected {expected}")
        shares[driver] = _parsed(f"tie {name}: weight of {driver}", weight) if star else 1.0
    return name, shares


def _prior_option(text: str) -> dict[str, tuple[float, float]]:
    expected = "NAME=MEAN+-SD"
    name, rest = _parted("prior", text, expected)
    values = re.split(r"\+-|±", rest)
    if len(values) != 2:
        raise ValueError(f"prior {text!r}; expected {expected}")
    mean, sd = (_parsed(f"prior {name}", each) for each in values)
    return dict.fromkeys(_names(name), (mean, sd))
