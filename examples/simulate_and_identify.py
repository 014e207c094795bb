"""How do I take a person of my own through the experiment, and what does the identification make of it?

Run `python examples/simulate_and_identify.py FOLDER`. It writes a subject and a perturbation into FOLDER and calls the
two commands that anyone could type.
"""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from armperturb import POSITION, Multisine, save_perturbation


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    # A stiffer elbow with weaker reflexes than the thesis's mean arm.
    replace(POSITION, name="mine", k_e=260.0, kv_e=18.0).save(folder / "mine.toml")
    save_perturbation(Multisine.draw(seed=1, rms=5.4), folder / "multisine.csv", rate=200.0)
    for command in (
        f"simulate --subject {folder}/mine.toml --perturbation {folder}/multisine.csv --out {folder}/mine.nc",
        f"identify {folder}/mine.nc --model 3b --out {folder}/identified",
    ):
        print(f"$ armperturb {command}")
        subprocess.run([sys.executable, "-m", "armperturb.cli", *command.split()], check=True)
    print((folder / "identified" / "parameters.csv").read_text())


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example"))
