"""`armperturb response`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from armperturb.analysis.defaults import SETTLED
from armperturb.commands.command import Command, Positional
from armperturb.files import earlier_removed, require_new_results, write_csv

if TYPE_CHECKING:
    import xarray as xr

    from armperturb.analysis.response.best_linear import BestLinear
    from armperturb.analysis.response.frequency_response import FrequencyResponse
    from armperturb.analysis.trials import ConditionTrials

RESULTS = ("response.csv", "response.svg", "distortion.csv", "distortion.svg")
"""Files that are written."""


@dataclass(frozen=True, kw_only=True)
class Response(Command):
    """Estimate a frequency response without a model of the arm, its uncertainty, and how nonlinear the arm is."""

    recordings: Positional[tuple[Path, ...]]
    """Recordings of one person in one condition: netCDF4, or CSV, MATLAB, NPZ or C3D with a sidecar (see convert);
    their lengths may differ."""
    out: Path
    """Folder for response.csv and response.svg; with multisines in two or more trials also distortion.csv and .svg. Of
    one axis, coherence and distortion are in response.csv."""
    sidecar: Path | None = None
    """Sidecar of all recordings that need one, see docs/recordings.md; by default FILE.json beside each."""
    method: Literal["multisine", "noise", "welch", "multitaper", "spectral", "arx", "subspace"] | None = None
    """By default multisine; of one axis noise, the only one there. For multisines of any lines and period, multisine,
    or spectral as in the thesis; for any disturbance with power at all frequencies, noise, welch or multitaper; for
    either, the models arx and subspace."""
    what: Literal["arm", "environment", "total"] = "arm"
    """Of what: the arm (from force to displacement), the manipulator, or both (from perturbation to displacement)."""
    subject: str | None = None
    """Which subject, if the recordings hold several."""
    condition: str | None = None
    """Which condition, if they hold several."""
    window_start: float | None = None
    """Start of what is used [s]; by default 2 for multisine, 8 for spectral, and 0 for the other methods."""
    period: float | None = None
    """Period of a multisine [s]; by default it is found from the data."""
    lines_per_average: int | None = None
    """Of the methods multisine and spectral: adjacent lines that share a point; by default 4. Lines that are far apart
    have 1."""
    overwrite: bool = False
    """Replace results of an earlier run in the folder; an input is never replaced."""

    def run(self) -> list[str]:
        """Estimate the response and write it."""
        from armperturb.analysis.periods import common_period
        from armperturb.analysis.pulses_alone import used_whole
        from armperturb.analysis.response.best_linear import best_linear
        from armperturb.analysis.response.estimate import response
        from armperturb.analysis.trials import prepared_recordings
        from armperturb.commands.selection import MemoryPerSample, select_trials
        from armperturb.recording import is_one_axis

        if self.method not in (None, "multisine", "spectral"):
            self._require_none_of_lines(f"with the method {self.method}")
        recordings, lines = select_trials(
            self.recordings, self.sidecar, self.subject, self.condition, single_condition=True
        )
        require_new_results(self.out, RESULTS, overwrite=self.overwrite)
        if is_one_axis(recordings[0]):
            return [*lines, *self._of_one_axis(recordings), f"results: {self.out}"]
        method = "multisine" if self.method is None else self.method
        options: dict[str, Any] = {"window_start": self.window_start, **self._of_lines()}
        options = {name: value for name, value in options.items() if value is not None}
        distortion = None
        try:
            MemoryPerSample(longest=0, all=1000).require(recordings)
            trials = used_whole(prepared_recordings(recordings))
            if method == "multisine":
                if self.period is None:
                    options["period"] = common_period(trials, options.get("window_start", SETTLED))
                lines.append(f"period: {options['period']:g} s")
            estimate = response(trials, method, what=self.what, **options)
        except ValueError as error:
            raise ValueError(f"{', '.join(map(str, self.recordings))}: {error}") from None
        lines.append(_manipulator(trials[0], was_used=estimate.environment is not None))
        lines.extend(remark for remark in estimate.remarks if remark not in lines)
        if estimate.covariance is None:
            lines.append(f"no uncertainty: {method} needs more trials for an estimate of it")
        if method == "multisine" and self.what == "arm":
            try:
                distortion = best_linear(trials, **options)
                lines.append(distortion.describe().facts[0])
                lines.extend(remark for remark in distortion.response.remarks if remark not in lines)
            except ValueError as error:
                lines.append(f"nonlinear distortion: not estimated ({error})")
        self._write({"response": estimate, "distortion": distortion})
        return [*lines, f"results: {self.out}"]

    def _of_one_axis(self, recordings: "list[xr.Dataset]") -> list[str]:
        from armperturb.analysis.response.estimate import response

        self._require_none_of_lines("of one axis")
        try:
            estimate = response(recordings, self.method, what=self.what, window_start=self.window_start or 0.0)
        except ValueError as error:
            raise ValueError(f"{', '.join(map(str, self.recordings))}: {error}") from None
        self._write({"response": estimate, "distortion": None})
        said = estimate.describe()
        return [said.title, *said.facts, *said.remarks]

    def _of_lines(self) -> dict[str, float | None]:
        """Options of methods for multisines."""
        return {"period": self.period, "lines_per_average": self.lines_per_average}

    def _require_none_of_lines(self, where: str) -> None:
        for name, value in self._of_lines().items():
            if value is not None:
                raise ValueError(f"response: {name} = {value:g}; expected none {where}")

    def _write(self, results: "dict[str, FrequencyResponse | BestLinear | None]") -> None:
        """Write tables and figures; what an earlier run has left is removed where there is no result of it."""
        from armperturb.plots.style import save_plot

        self.out.mkdir(parents=True, exist_ok=True)
        with earlier_removed(self.out / name for name in RESULTS):
            for name, result in results.items():
                if result is not None:
                    write_csv(result.to_frame(), self.out / f"{name}.csv")
                    save_plot(result, self.out / f"{name}.svg")


def _manipulator(trials: "ConditionTrials", *, was_used: bool) -> str:
    """The manipulator as the trials show it, and whether its force balance made the signals better."""
    from armperturb.commands.selection import manipulator

    try:
        return manipulator(trials.environment) + (", whose force balance was used" if was_used else "")
    except ValueError as error:
        return f"manipulator: not identified ({error})"
