"""How much of a person's response is nonlinear?

Run `python examples/how_nonlinear_is_my_subject.py [FILE ...] [--sidecar FILE.json] [--out FOLDER]`. It needs two or
more trials of one condition with different multisines, each of more than a period; by default it takes the relax task
of examples/data, whose person has nonlinear muscles. A linear person with the same noise, simulated under the same
multisines, is the control: what the method finds there is chance.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import xarray as xr

import armperturb as ap

DATA = Path(__file__).parent / "data"


def control(recording: xr.Dataset) -> xr.Dataset:
    """The thesis's mean arm in the same task, linear by construction, under the same perturbations."""
    task, rate = str(recording["task"].values[0]), float(recording.attrs["rate"])
    onset = recording["pulse_onset"].values[0]
    end = recording.sizes["time"] if np.isnan(onset) else round(onset * rate)
    trials = [
        ap.Trial(
            subject={"PT": ap.POSITION, "RT": ap.RELAX}[task],
            perturbation=ap.Sampled(force=force[:end], rate=rate),
            seed=number,
            noise=ap.HUMAN_NOISE[task],
        )
        for number, force in enumerate(recording["perturbation"].values.astype(float))
    ]
    return ap.run_experiment(trials, linear=True, instruments=ap.Instruments(marker_noise=None, emg=None))


def main(files: list[Path], sidecar: Path | None, folder: Path) -> None:
    recording, notes = ap.import_recording(files, sidecar=sidecar)
    print(*notes, sep="\n", end="\n" if notes else "")
    folder.mkdir(parents=True, exist_ok=True)
    for name, trials in {"recording": recording, "linear person": control(recording)}.items():
        result = ap.best_linear(trials)
        print(f"{name}:")
        for axis, share, error in zip("xy", result.share, result.share_error, strict=True):
            print(
                f"  {axis}: {100 * share:5.1f} % of the power is distortion (of a linear arm 0 +- {100 * error:.1f} %)"
            )
        linear = "no sign of nonlinearity" if result.p_value >= 0.05 else "not linear"
        print(f"  p = {result.p_value:.2g} if the arm is linear: {linear}")
        figure = ap.plot(result)[0].figure
        figure.savefig(folder / f"{name.replace(' ', '_')}.png", dpi=110)
    print(f"wrote {folder}")


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
