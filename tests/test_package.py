"""What an installation contains."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_every_file_that_is_no_code_is_installed():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    patterns = project["tool"]["setuptools"]["package-data"]["armperturb"]
    package = ROOT / "armperturb"
    installed = {path for pattern in patterns for path in package.glob(pattern)}
    files = {path for path in package.rglob("*") if path.is_file() and path.suffix != ".py"}
    files = {path for path in files if "__pycache__" not in path.parts}
    assert files == installed
    assert all(list(package.glob(pattern)) for pattern in patterns)


def test_every_folder_of_code_is_a_package():
    for folder in {path.parent for path in (ROOT / "armperturb").rglob("*.py")}:
        assert (folder / "__init__.py").is_file(), folder
