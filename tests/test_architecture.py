"""One direction of imports, and a face that loads light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import armperturb

ROOT = Path(armperturb.__file__).parent
BASE = {"validation", "files", "muscle_law", "subject", "environment", "recording"}
ARROWS = {
    "validation": set(),
    "files": set(),
    "muscle_law": {"validation"},
    "subject": {"validation", "muscle_law"},
    "environment": {"validation"},
    "recording": {"files"},
    "perturbations": {"validation", "files"},
    "analysis": BASE,
    "convert": BASE | {"analysis"},
    "cohort": BASE | {"analysis"},
    "controllers": {"muscle_law", "subject", "validation"},
    "models": {"subject", "environment", "validation"},
    "envs": BASE | {"cohort", "models", "controllers", "perturbations", "analysis"},
    "nonlinear": BASE | {"controllers", "analysis"},
    "study": BASE | {"cohort", "models", "controllers", "perturbations", "analysis", "envs", "nonlinear"},
    "cli": BASE | {"cohort", "perturbations", "analysis", "convert", "envs", "nonlinear", "study"},
}
"""Part of the package to the parts that it may import, beside itself."""

MODULES = sorted(path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py")


def part(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_follow_the_arrows(path):
    ours = {name.split(".")[1] for name in imported(path) if name.startswith("armperturb.")}
    assert ours <= ARROWS[part(path)] | {part(path)}


def test_importing_what_needs_none_loads_no_simulator():
    modules = ("armperturb", "armperturb.analysis", "armperturb.analysis.identify", "armperturb.cli")
    code = f"import sys\nfor name in {modules}:\n    __import__(name)\n    assert 'mujoco' not in sys.modules, name"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
