"""What figures of commands and reports share, and `plot`, which draws a recording or a result."""

from typing import Any

import xarray as xr


def plot(item: Any, **options: Any) -> Any:
    """Draw a recording or a result of an analysis.

    Args:
      item: a recording, see `plots.recordings.plot_recording`; or a result with a method `plot`.
      **options: of that function or method: `trial` of recordings, `figure` of all.

    Returns:
      Matplotlib axes; their figure is `numpy.ravel(axes)[0].figure`.

    Raises:
      TypeError: the item is neither.
      ValueError: a recording is refused, or holds no such trial.
    """
    if isinstance(item, xr.Dataset):
        from armperturb.plots.recordings import plot_recording

        return plot_recording(item, **options)
    if not hasattr(item, "plot"):
        raise TypeError(f"plot: item of type {type(item).__name__}; expected a recording or a result of an analysis")
    return item.plot(**options)
