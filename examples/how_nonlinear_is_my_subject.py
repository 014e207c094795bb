"""How much of a person's response is no linear one?

Run `python examples/how_nonlinear_is_my_subject.py [FILE ...] [--sidecar FILE.json] [--out FOLDER]`. It needs two or
more trials of one condition with different multisines, each of more than a period (docs/method.md); by default it takes
the relax task of examples/data, whose person has muscles that yield. A linear person, simulated on the spot under the
same multisines and as noisy, stands beside: what the method finds there is chance.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from armperturb import identify
from armperturb.analysis.measures.pulse import pulse_peaks, pulse_prediction
from armperturb.analysis.response.best_linear import BestLinear, best_linear
from armperturb.convert import import_recording

DATA = Path(__file__).parent / "data"


def control(recording: xr.Dataset) -> xr.Dataset:
    """The thesis's mean arm in the same task, linear by construction, under the same perturbations."""
    from armperturb import POSITION, RELAX, Instruments, Trial, run_experiment
    from armperturb.controllers.remnant import HUMAN_NOISE
    from armperturb.perturbations import Sampled

    task, rate = str(recording["task"].values[0]), float(recording.attrs["rate"])
    onset = recording["pulse_onset"].values[0]
    end = recording.sizes["time"] if np.isnan(onset) else round(onset * rate)
    trials = [
        Trial(
            subject={"PT": POSITION, "RT": RELAX}[task],
            perturbation=Sampled(force=force[:end], rate=rate),
            seed=number,
            noise=HUMAN_NOISE[task],
        )
        for number, force in enumerate(recording["perturbation"].values.astype(float))
    ]
    return run_experiment(trials, linear=True, instruments=Instruments(marker_noise=None, emg=None))


def tell(name: str, found: BestLinear) -> None:
    total = found.linear.sum() + found.distortion.sum()
    print(f"{name}:")
    for axis, share, error in zip("xy", found.share, found.share_error, strict=True):
        print(f"  {axis}: {100 * share:5.1f} % of the power is distortion (of a linear arm 0 +- {100 * error:.1f} %)")
    print(f"  noise at a line of one period: {100 * found.noise.sum() / total:.1f} %")
    chance = "under 0.0001" if found.p_value < 1e-4 else f"{found.p_value:.2g}"
    print(f"  a linear arm shows as much with a chance of {chance}: {verdict(found)}")


def verdict(found: BestLinear) -> str:
    return "not linear" if found.p_value < 0.05 else "no sign of nonlinearity"


def picture(people: dict[str, BestLinear]) -> Figure:
    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    for row, (name, found) in zip(panels, people.items(), strict=True):
        for axis, axes in enumerate(row):
            for label, power, look in (
                ("linear response", found.linear, "ko-"),
                ("distortion", found.distortion, "C1o-"),
                ("noise", found.noise, "C0o-"),
                ("distortion of a linear arm, 95 %", 1.645 * found.distortion_error, "C1:"),
            ):
                shown = np.where(power[:, axis] > 0.0, power[:, axis], np.nan)  # none is below zero by chance
                axes.loglog(found.response.frequency, 1e3 * np.sqrt(shown), look, markersize=3, label=label)
            axes.set(title=f"{name}, {'xy'[axis]}")
    for axes in panels[:, 0]:
        axes.set(ylabel="RMS of a line [mm]")
    for axes in panels[1]:
        axes.set(xlabel="frequency [Hz]")
    panels[0, 1].legend(frameon=False, fontsize=8)
    return figure


def main(files: list[Path], sidecar: Path | None, folder: Path) -> None:
    recording, notes = import_recording(files, sidecar=sidecar)
    print(*notes, sep="\n", end="\n" if notes else "")
    people = {"recording": best_linear(recording), "linear person": best_linear(control(recording))}
    for name, found in people.items():
        tell(name, found)
    if np.isfinite(recording["pulse_onset"].values).all() and (recording["task"] == "RT").all():
        # A second question to the same trials: does the arm that fits the multisine predict the pulse at its end?
        arm = identify(recording, model="1")
        predicted = pulse_prediction(recording, arm.fit.arm, arm.environment)
        peaks = 1e3 * pulse_peaks(recording).displacement
        print(f"pulses: {peaks.mean():.0f} mm, of which the best linear arm predicts {predicted.mean():.0f} %")
    folder.mkdir(parents=True, exist_ok=True)
    picture(people).savefig(folder / "how_nonlinear_is_my_subject.png", dpi=110)
    print(f"wrote {folder / 'how_nonlinear_is_my_subject.png'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, default=[DATA / "relax.nc"], metavar="FILE")
    parser.add_argument("--sidecar", type=Path)
    parser.add_argument("--out", type=Path, default=Path("example"), metavar="FOLDER")
    given = parser.parse_args()
    try:
        main(given.files, given.sidecar, given.out)
    except (TypeError, ValueError, OSError) as error:
        sys.exit(f"{error}")
