"""Run the tutorials and write their pages, pictures and notebooks: `python docs/tutorials/make.py [NAME ...]`.

A tutorial is a script in examples/ whose cells begin with `# %%`. Its page shows each cell with what it printed and
drew; a cell that draws names its pictures with `alt="..."`. The notebook has the same cells without output.
"""

import ast
import contextlib
import io
import os
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import jupytext
import matplotlib

FOLDER = Path(__file__).resolve().parent
EXAMPLES = FOLDER.parents[1] / "examples"
NAMES = ("fit_my_recording", "simulate_a_laboratory", "plan_an_experiment", "train_an_agent", "is_this_arm_human")


class Cell(NamedTuple):
    """A cell of a tutorial: markdown or code, and what its pictures show."""

    kind: str
    source: str
    alt: str


class Output(NamedTuple):
    """What a cell printed, and its pictures as PNG."""

    text: str
    pictures: list[bytes]


def cells(name: str) -> list[Cell]:
    """The cells of a tutorial's script."""
    read = jupytext.read(EXAMPLES / f"{name}.py", fmt="py:percent")
    return [Cell(cell.cell_type, cell.source, cell.metadata.get("alt", "")) for cell in read.cells]


def notebook(name: str) -> str:
    """A tutorial as a notebook without output."""
    read = jupytext.read(EXAMPLES / f"{name}.py", fmt="py:percent")
    read.metadata = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    for number, cell in enumerate(read.cells):
        cell.id = f"cell-{number}"
    return jupytext.writes(read, fmt="ipynb") + "\n"


def run(name: str) -> list[Output]:
    """Run a tutorial as a notebook would be, in a folder that is thrown away, and return the output of each cell."""
    import matplotlib.pyplot as plt

    matplotlib.use("agg")
    names: dict[str, Any] = {"__name__": "__main__"}
    outputs = []
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        os.symlink(EXAMPLES, "examples")
        for cell in cells(name):
            printed = io.StringIO()
            if cell.kind == "code":
                with contextlib.redirect_stdout(printed):
                    _execute(cell.source, names)
            pictures = []
            for number in plt.get_fignums():
                picture = io.BytesIO()
                plt.figure(number).savefig(picture, format="png", dpi=100, bbox_inches="tight")
                pictures.append(picture.getvalue())
            plt.close("all")
            outputs.append(Output(printed.getvalue(), pictures))
    return outputs


def _execute(source: str, names: dict[str, Any]) -> None:
    """Run a cell; print the value of its last expression, as a notebook shows it, unless the cell draws."""
    import matplotlib.pyplot as plt

    body = ast.parse(source).body
    last = body.pop() if body and isinstance(body[-1], ast.Expr) else None
    exec(compile(ast.Module(body, []), "tutorial", "exec"), names)
    if isinstance(last, ast.Expr):
        value = eval(compile(ast.Expression(last.value), "tutorial", "eval"), names)
        if value is not None and not plt.get_fignums():
            print(value)


def page(name: str, outputs: list[Output]) -> tuple[str, dict[str, bytes]]:
    """A tutorial as markdown, and the pictures that it shows."""
    parts, pictures = [], {}
    for number, (cell, output) in enumerate(zip(cells(name), outputs, strict=True)):
        if cell.kind == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        if output.text:
            parts.append(f"```text\n{output.text.rstrip()}\n```")
        for place, picture in enumerate(output.pictures):
            file = f"{name}_{number}{'abcdef'[place]}.png"
            pictures[file] = picture
            parts.append(f"![{cell.alt}]({file})")
    parts.append(
        f"*This page is the script `examples/{name}.py`, executed. As a notebook: [{name}.ipynb]({name}.ipynb).*"
    )
    return "\n\n".join(parts) + "\n", pictures


def main(chosen: list[str]) -> None:
    for name in chosen or NAMES:
        text, pictures = page(name, run(name))
        for old in FOLDER.glob(f"{name}_*.png"):
            old.unlink()
        for file, picture in pictures.items():
            (FOLDER / file).write_bytes(picture)
        (FOLDER / f"{name}.md").write_text(text, encoding="utf-8")
        (FOLDER / f"{name}.ipynb").write_text(notebook(name), encoding="utf-8")
        print(f"wrote {name}: {len(pictures)} pictures, {sum(map(len, pictures.values())) / 1e3:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
