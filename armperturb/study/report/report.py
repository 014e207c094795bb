"""The report of a study: tables, figures, and one HTML file that holds everything and opens offline."""

from collections.abc import Callable, Collection, Mapping
from functools import partial
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import Any

from armperturb.files import checksum, write_whole, written_together
from armperturb.pages.page import Picture, rendered, versions
from armperturb.perturbations.multisine import CLUSTERS, PERIOD
from armperturb.progress import Progress
from armperturb.study.comparison.effects import effects
from armperturb.study.comparison.score import score, write_score
from armperturb.study.experiments.mechanisms import Yielding, has_law, why_people_yield
from armperturb.study.experiments.moving_shoulder import MovingShoulder, moving_shoulder
from armperturb.study.recording.folder import ANALYSIS, require_own_results
from armperturb.study.recording.record import worker_count
from armperturb.study.report.emg import emg_drawings, emg_rows
from armperturb.study.report.figures.catalogue import Drawings, drawings, drawings_of_yielding
from armperturb.study.report.films import film_units
from armperturb.study.report.findings import excess_rows, finding_rows, findings
from armperturb.study.report.nonlinear_tables import nonlinear_tables
from armperturb.study.report.pictures import picture_units
from armperturb.study.report.played import played_data, played_units
from armperturb.study.report.provenance import provenance
from armperturb.study.report.sections import joint_rows, of_people, sections
from armperturb.study.report.tables import write_or_remove, write_tables
from armperturb.study.report.words import WORDS
from armperturb.study.results.cache import CachedResult, Unit, kept_or_computed
from armperturb.study.results.mean_admittance import by_task, main_conditions
from armperturb.study.results.quantities import published_cells
from armperturb.study.results.study_result import StudyResult
from armperturb.validation import require_type
from armperturb.workers import LocalProcesses, require_workers, workers_for

MOST_WORKERS = 8
"""Processes that drawing is shared between at most: each has to load what draws."""


def write_report(
    study: StudyResult,
    out: str | Path,
    *,
    figures: Collection[str] | None = None,
    simulate: bool = True,
    workers: int | None = 1,
    show_progress: bool = True,
) -> Path:
    """Write `tables/*.csv`, `score/`, `figures/*.svg` and `report.html`, which needs none of them nor a network.

    Without a GL library, pictures of the rig are left out and the report says so.

    Args:
      study: the analysed study; its recordings must still be there.
      out: folder, which is made if needed.
      figures: names of those that are drawn, see `figures.catalogue`; None for all that the study allows.
      simulate: whether some more trials of the first person are simulated, to show the effects of the muscle law and
        of a moving shoulder; they are kept in the folder, as results are.
      workers: number of processes; None for about one per core. No effect on the files but for rounding.
      show_progress: whether to draw progress bars on the terminal.

    Returns:
      The path of the report.

    Raises:
      TypeError: study is no analysed one, or workers no whole number.
      ValueError: workers is out of its range.
      OSError: the folder cannot be written to, or a recording is gone.
      RuntimeError: workers die again and again.
    """
    require_type("report: study", study, StudyResult, "an analysed study (analyse_study of its folder)")
    require_workers("report", workers)
    out = Path(out)
    require_own_results(out)
    checksums = {path.name: checksum(path) for path in study.recordings.values()}
    with workers_for(worker_count(workers, MOST_WORKERS), None, [__name__]) as pool:
        if isinstance(pool, LocalProcesses) and not any((out / ANALYSIS).glob("figure-*")):
            pool.start()  # as they will be needed, and this process is busy first
        rows = write_tables(study, out / "tables")
        tested = effects(study)
        # Without a condition of the published tables there is nothing to compare.
        compared = any(person.cells.keys() & published_cells().keys() for person in study.people)
        scored = score(study) if compared else None
        if scored is not None:
            write_score(scored, out / "score")
        simulations = _simulations(study, out) if simulate else {}
        draws = _wanted({**drawings(study, tested), **emg_drawings(study)}, figures)
        pulses = draws["stills"].args[-1] if "stills" in draws else ()
        # What others wait for and what takes longest comes first, so that workers end together.
        kinds: dict[str, list[Unit[Any]]] = {
            "simulated": list(simulations.values()),
            "films": film_units(pulses, checksums, out),
            "drawn": picture_units(draws, checksums, out),
            "played": played_units(study, checksums, out),
        }
        units = [unit for of_kind in kinds.values() for unit in of_kind]
        with Progress("figures", total=len(units), unit="figures", show=show_progress) as bar:
            computed_or_kept = iter(kept_or_computed(units, pool, bar))
        made = {kind: list(islice(computed_or_kept, len(of_kind))) for kind, of_kind in kinds.items()}
        simulated = dict(zip(simulations, made["simulated"], strict=True))
        yielding, shoulder = simulated.get("mechanisms"), simulated.get("moving-shoulder")
        later = _wanted(drawings_of_yielding(yielding) if yielding else {}, figures)
        shown = show_progress and bool(later)
        with Progress("figures of the muscle law", total=len(later), unit="figures", show=shown) as bar:
            explained = kept_or_computed(picture_units(later, checksums, out), pool, bar)
    drawn = dict(zip([*draws, *later], [*made["drawn"], *explained], strict=True))
    (out / "figures").mkdir(exist_ok=True)
    pictures = {out / "figures" / f"{name}.svg": each for name, each in drawn.items() if isinstance(each, Picture)}
    with written_together(pictures) as temporary:
        for path, picture in zip(temporary, pictures.values(), strict=True):
            path.write_text(picture.svg, encoding="utf-8", newline="")
    more = {
        "findings": finding_rows(findings(study)),
        "pulse_excess": excess_rows(study),
        "statistics": list(tested.rows),
        "statistics_pairs": list(tested.pairs),
        "joints": joint_rows(study),
        "yielding": yielding.rows() if yielding else [],
        "moving_shoulder": shoulder.rows if shoulder else [],
        **nonlinear_tables(study),
        **emg_rows(study),
    }
    for name, lines in more.items():
        write_or_remove(lines, out / "tables" / f"{name}.csv")
    films = made["films"][0] if made["films"] else ""
    parts = sections(
        study,
        scored,
        tested,
        rows,
        yielding=yielding,
        shoulder=shoulder,
        drawn=drawn,
        played=played_data(made["played"]),
        films=films,
        stills=[str(trial["task"].values[0]) for trial in pulses],
    )
    page = _page(study, parts, drawn, checksums)
    report = out / "report.html"
    write_whole(report, page)
    return report


def _wanted(draws: Drawings, figures: Collection[str] | None) -> Drawings:
    return {name: draw for name, draw in draws.items() if figures is None or name in figures}


def _simulations(study: StudyResult, out: Path) -> dict[str, Unit[Any]]:
    """What a moving shoulder does to the first person and, if it has one, the muscle law; nothing of nobody."""
    if not study.cohort:
        return {}
    person = study.cohort[0]
    strap = study.protocol.strap
    functions: dict[str, tuple[Callable[..., Any], type]] = {
        "moving-shoulder": (partial(moving_shoulder, strap=strap), MovingShoulder)
    }
    if has_law(person):
        functions["mechanisms"] = why_people_yield, Yielding
    source = {"person": repr(person), "environment": repr(study.environment), "seed": study.seed}
    # The muscle law is shown of a shoulder that is held, whatever the strap.
    sources = {"moving-shoulder": {**source, "strap": repr(strap)}} if strap else {}
    return {
        kind: Unit(
            cached=CachedResult(
                path=out / ANALYSIS / f"{kind}.json.gz",
                kind=kind,
                result=result,
                settings=sources.get(kind, source),
            ),
            run=partial(function, person, environment=study.environment, seed=study.seed),
        )
        for kind, (function, result) in functions.items()
    }


def _page(
    study: StudyResult,
    parts: Mapping[str, Mapping[str, Any]],
    drawn: Mapping[str, Picture | str],
    checksums: Mapping[str, str],
) -> str:
    return rendered(
        "armperturb.study.report",
        "report.html",
        parts,
        WORDS["sections"],
        drawn,
        study=study,
        over_people=", mean ± SD over people" if len(study.names) > 1 else "",
        people=of_people(study, {}),
        intervals=" with 95\N{NO-BREAK SPACE}% intervals" if len(study.names) > 1 else "",
        first=next(iter(study.recordings), ""),
        main={task: study.of(condition.name)[0] for task, condition in main_conditions(study).items()},
        tasks=by_task(study),
        multisine={"period": PERIOD, "lines": CLUSTERS.size, "clusters": len(CLUSTERS)},
        versions=versions("armperturb", "mujoco", "numpy", "scipy"),
        origin=provenance(study, checksums),
        licence=metadata.metadata("armperturb")["License-Expression"],
    )
