"""What the command `response` writes: table and figure of a frequency response, and of the arm's distortion."""

from pathlib import Path

from armperturb.analysis.response.best_linear import BestLinear
from armperturb.analysis.response.frequency_response import FrequencyResponse
from armperturb.files import write_csv
from armperturb.plots.style import new_figure, save_svg
from armperturb.recording import LABELS


def distortion_text(found: BestLinear) -> str:
    """The share of the distortion in one line; negative shares, which chance makes, are none."""
    both = zip(found.share, found.share_error, strict=True)
    shares = (f"{max(share, 0.0):.1%} (+- {error:.1%})" for share, error in both)
    in_each = " and ".join(f"{share} in {axis}" for share, axis in zip(shares, LABELS["axis"], strict=True))
    return f"nonlinear distortion: of the response's power {in_each}; p = {found.p_value:.2g} if the arm is linear"


def write_response(
    found: FrequencyResponse, distortion: BestLinear | None, folder: str | Path, condition: str
) -> list[Path]:
    """Write `response.csv` and `response.svg`, and `distortion.csv` and `.svg` if there are any, into a folder.

    Args:
      found: the response.
      distortion: levels of noise and distortion; None removes those of an earlier run.
      folder: where; it is made if needed.
      condition: for the last column of the tables.

    Returns:
      The paths written.

    Raises:
      OSError: the folder cannot be made or written to.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in ("response.csv", "response.svg", "distortion.csv", "distortion.svg")]
    write_csv(found.to_frame().assign(condition=condition), paths[0])
    _save(found, paths[1])
    if distortion is None:
        for path in paths[2:]:
            path.unlink(missing_ok=True)
        return paths[:2]
    write_csv(distortion.to_frame().assign(condition=condition), paths[2])
    _save(distortion, paths[3])
    return paths


def _save(result: FrequencyResponse | BestLinear, path: Path) -> None:
    figure = new_figure(1.0)
    result.plot(figure=figure)
    save_svg(figure, path)
