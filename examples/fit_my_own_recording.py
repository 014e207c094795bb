"""What does a recording of mine say about the arm?

Run `python examples/fit_my_own_recording.py [FILE ...] [--sidecar FILE.json] [--out FOLDER]`. FILE is CSV, MATLAB or
C3D with a sidecar beside it (docs/recordings.md), or netCDF of our own; by default it is the position task of
examples/data. The steps: read and hold against physics, admittance with its uncertainty, a model of the arm with 95 %
intervals.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from armperturb import arm_admittance, identify
from armperturb.analysis.fit.structures import unit
from armperturb.analysis.response.closed_loop import estimate_multisine
from armperturb.convert import import_recording

DATA = Path(__file__).resolve().parent / "data"
MODEL = {"PT": "3b", "RT": "1"}
"""Who keeps position has damping, stiffness, and reflexes of velocity and position; who relaxes has no reflexes."""


def main(files: list[Path], sidecar: Path | None, folder: Path) -> None:
    # Refused here, with one line that says why: gaps, clipped channels, wrong units, signs and axes.
    recording, notes = import_recording(files, sidecar=sidecar)
    duration = recording.sizes["time"] / recording.attrs["rate"]
    print(f"{recording.sizes['trial']} trials of {duration:g} s, {recording['condition'].values[0]}")
    print(*(notes or ["no faults; d - f moves a mass, spring and damper, as it should"]), sep="\n")

    admittance = estimate_multisine(recording)
    known = np.median(admittance.radius() / np.abs(admittance.response))
    print(f"admittance at {len(admittance.frequency)} frequencies, within {known:.0%} (95 %, median over elements)")

    model = MODEL[str(recording["task"].values[0])]
    found = identify(recording, model=model)
    fit, manipulator = found.fit, found.environment
    print(f"manipulator: {manipulator.m_env:.2f} kg, {manipulator.b_env:.2f} Ns/m, {manipulator.k_env:.1f} N/m")
    print(f"model {model}: {fit.message}; explains {found.vaf[0]:.0f} and {found.vaf[1]:.0f} % of x and y")
    for remark in fit.remarks:
        print(f"beware: {remark}")

    # Of a person nobody knows the truth; of the example it lies beside the data.
    truth = (
        json.loads((DATA / "truth.json").read_text())["position"]
        if model == "3b" and files[0].resolve().parent == DATA
        else {}
    )
    print(f"\n{'':7}{'estimate':>9}{'95 % interval':>19}  {'unit':8}{'truth' if truth else '':>9}")
    for name, value in fit.values.items():
        low, high = fit.interval(name)
        told = f"{truth[name]:9.2f}  {'inside' if low <= truth[name] <= high else 'outside'}" if truth else ""
        print(f"{name:7}{value:9.2f}{low:10.2f}{high:9.2f}  {unit(name):8}{told}")
    if truth:
        print("m_tot: the model takes 49 % of it for the upper arm; of this person it is 52 %. No interval tells that.")

    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    bands, frequency = admittance.bands(), admittance.frequency
    fine = np.geomspace(frequency[0], frequency[-1], 300)
    of_model = np.abs(arm_admittance(fit.arm, fine))
    for axes, (i, j) in zip(figure.subplots(2, 2, sharex=True, sharey=True).flat, np.ndindex(2, 2), strict=True):
        gain = np.abs(admittance.response[:, i, j])
        low = np.maximum(bands.gain_low[:, i, j], 0.03 * gain)  # a logarithmic axis has no zero
        axes.fill_between(frequency, low, bands.gain_high[:, i, j], alpha=0.3, lw=0, label="95 %")
        axes.loglog(frequency, gain, "o", markersize=3, label="estimate without a model")
        axes.loglog(fine, of_model[:, i, j], "k-", lw=1, label=f"model {model}")
        axes.set(title=f"from force {'xy'[j]} to displacement {'xy'[i]}")
        axes.set(xlabel="frequency [Hz]" if i else "", ylabel="" if j else "gain [m/N]")
    axes.legend(frameon=False)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "fit_my_own_recording.png", dpi=110)
    print(f"wrote {folder / 'fit_my_own_recording.png'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, default=[DATA / "position.csv"], metavar="FILE")
    parser.add_argument("--sidecar", type=Path)
    parser.add_argument("--out", type=Path, default=Path("example"), metavar="FOLDER")
    given = parser.parse_args()
    try:
        main(given.files, given.sidecar, given.out)
    except (TypeError, ValueError, OSError) as error:
        sys.exit(f"{error}")
