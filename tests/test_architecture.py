"""One direction of imports."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import armperturb

ROOT = Path(armperturb.__file__).parent

BASE = {"arrays", "memory", "validation", "extras", "seeds", "files", "foreign", "recording", "recording_files"}
BASE |= {"joined_recordings", "jit", "muscle_law", "person_files", "subject", "environment", "joint_person"}
BASE |= {"copied_trials"}
ARM = BASE | {
    "analysis.cuts", "analysis.defaults", "analysis.plateaus", "analysis.arm", "analysis.excited_bands",
    "analysis.imbalance", "analysis.smoother", "analysis.force_balance", "analysis.trials", "analysis.per_trials",
    "analysis.manipulator", "analysis.numerics", "analysis.start", "analysis.pulses_alone", "analysis.periods",
    "analysis.results", "analysis.signs", "analysis.joint_balance", "plots", "anthropometry",
}  # fmt: skip
OF_TRIALS = {"analysis.per_trials", "analysis.manipulator", "analysis.pulses_alone", "analysis.periods"}
ANALYSIS = ARM | {"analysis.response", "analysis.measures", "analysis.emg", "analysis.fit", "analysis.nonlinear"}
ANALYSIS |= {"analysis.varying"}
LAB = ARM | {"perturbations", "models", "controllers", "planar_arm", "cohort"}
STUDY = LAB | ANALYSIS | {"envs.lab", "archive", "workers", "progress", "study.protocol", "study.published"}
ARROWS = {
    "arrays": set(),
    "memory": set(),
    "validation": {"files"},
    "files": set(),
    "compile_cache": set(),
    "extras": {"files"},
    "seeds": {"validation"},
    "jit": {"compile_cache"},
    "muscle_law": {"validation"},
    "person_files": {"files", "validation", "muscle_law"},
    "subject": {"files", "validation", "muscle_law", "person_files"},
    "environment": {"validation"},
    "joint_person": {"files", "validation", "muscle_law", "person_files", "subject"},
    "anthropometry": {"files", "validation"},
    "foreign": {"extras", "files"},
    "recording": {"files", "validation"},
    "joined_recordings": {"recording", "validation"},
    "copied_trials": {"recording"},
    "recording_files": {"files", "foreign", "recording", "validation"},
    "archive": {"files"},
    "workers": {"extras", "memory", "validation"},
    "progress": set(),
    "perturbations": BASE,
    "controllers": BASE,
    "planar_arm": ARM | {"controllers", "perturbations"},
    "models": BASE,
    "analysis.cuts": BASE,
    "analysis.defaults": BASE,
    "analysis.plateaus": BASE,
    "analysis.numerics": BASE,
    "analysis.arm": BASE,
    "analysis.excited_bands": BASE,
    "analysis.imbalance": BASE | {"analysis.excited_bands"},
    "analysis.smoother": BASE,
    "analysis.force_balance": BASE | {"analysis.excited_bands", "analysis.imbalance", "analysis.smoother"},
    "analysis.signs": BASE | {"analysis.cuts", "analysis.imbalance", "analysis.force_balance"},
    "analysis.joint_balance": BASE | {"analysis.cuts", "analysis.force_balance", "analysis.plateaus"},
    "plots": BASE,
    "pages": BASE | {"plots"},
    "analysis.results": BASE | {"plots"},
    "analysis.start": BASE,
    "analysis.trials": ARM - {"analysis.trials", *OF_TRIALS},
    "analysis.per_trials": ARM - OF_TRIALS,
    "analysis.manipulator": ARM - OF_TRIALS | {"analysis.per_trials"},
    "analysis.pulses_alone": ARM - OF_TRIALS,
    "analysis.periods": ARM - OF_TRIALS,
    "analysis.response": ARM,
    "analysis.measures": ARM,
    "analysis.fit": ARM | {"analysis.response", "analysis.measures", "analysis.emg"},
    "analysis.varying": ARM | {"analysis.fit", "analysis.joint"},
    "analysis.joint": ARM | {"analysis.fit"},
    "analysis.page": ARM
    | {"analysis.response", "analysis.measures", "analysis.fit", "analysis.joint", "analysis.emg", "analysis.nonlinear"}
    | {"pages"},
    "analysis.emg": ARM | {"analysis.measures", "analysis.response"},
    "analysis.nonlinear": ARM
    | {"analysis.response", "analysis.measures", "analysis.fit", "analysis.emg", "planar_arm", "archive"},
    "cohort": ARM,
    "convert": ARM | {"analysis.measures"},
    "envs.lab": LAB,
    "envs.render": LAB | {"analysis.measures"},
    "envs.learning": LAB | {"envs.lab", "envs.render"},
    "live": LAB | {"pages"},
    "study.published": BASE,
    "study.protocol": LAB | {"envs.lab"},
    "study.recording": LAB | {"envs.lab", "workers", "progress", "study.protocol"},
    "study.results": STUDY | {"study.recording"},
    "study.comparison": STUDY | {"study.results"},
    "study.experiments": STUDY | {"study.recording", "study.results"},
    "study.planning": STUDY,
    "study.validation": STUDY,
    "study.report": STUDY
    | {"study.recording", "study.results", "study.comparison", "study.experiments", "envs.render", "pages"},
}
ARROWS["commands"] = {*ARROWS, "envs.learning"}
ARROWS["cli"] = {*ARROWS}
"""Room to the rooms that it may import, beside itself. A room stands below all that import it."""

DIVIDED = ("analysis", "envs", "study")
"""Folders whose folders and files are rooms of their own."""

MODULES = sorted(path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py")


def room(module: str) -> str:
    """Room of a module whose name is given without the package's."""
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] in DIVIDED else parts[0]


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def statements(tree: ast.AST) -> Iterator[ast.AST]:
    """All statements, wherever they stand; not their expressions, of which there are ten times as many."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        for block in ("body", "orelse", "handlers", "finalbody", "cases"):
            inside = getattr(node, block, ())
            waiting += inside if isinstance(inside, list) else ()


def imported(path: Path) -> set[str]:
    names = set()
    for node in statements(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_follow_the_arrows(path):
    own = room(module_of(path))
    if own in DIVIDED:
        assert not imported(path)
        return
    ours = {room(name.removeprefix("armperturb.")) for name in imported(path) if name.startswith("armperturb.")}
    assert ours <= ARROWS[own] | {own}


def test_a_file_has_450_lines_at_most():
    assert not {path.name for path in MODULES if len(path.read_text(encoding="utf-8").splitlines()) > 450}


def test_the_table_has_no_circle():
    below: dict[str, set[str]] = {}

    def reach(name, path=()):
        assert name not in path, " -> ".join((*path, name))
        if name not in below:
            below[name] = set().union(ARROWS[name], *(reach(other, (*path, name)) for other in ARROWS[name]))
        return below[name]

    for name in ARROWS:
        reach(name)
