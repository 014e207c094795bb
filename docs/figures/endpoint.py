"""The picture of the identification page: impedance at the hand of one simulated person in both tasks.

Run `python docs/figures/endpoint.py FOLDER`. It simulates sixteen trials of the average person in each task, with noise
of people and instruments, identifies the arm, and writes endpoint.png into FOLDER.
"""

import sys
from pathlib import Path

import armperturb as ap
from armperturb.analysis.measures.endpoint import EndpointImpedance, plot_endpoints
from armperturb.plots.style import new_figure, save_png


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    figure = new_figure(1.0)
    plot_endpoints({f"{task} task": identified(task) for task in ("position", "relax")}, figure)
    save_png(figure, folder / "endpoint.png")


def identified(task: str) -> EndpointImpedance:
    """Of the average person, who is linear, in one task."""
    subject, rms, model = {"position": (ap.POSITION, 5.4, "3b"), "relax": (ap.RELAX, 1.2, "1")}[task]
    noise = ap.HUMAN_NOISE[subject.task]
    trials = [
        ap.Trial(subject=subject, perturbation=ap.Multisine.draw(seed=seed, rms=rms), noise=noise, seed=seed)
        for seed in range(16)
    ]
    result = ap.identify(ap.run_experiment(trials, instruments=ap.Instruments()), model)
    print(result.endpoint())
    return result.endpoint()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
