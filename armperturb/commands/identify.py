"""`armperturb identify`."""

import json
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from armperturb.analysis.defaults import LINES_PER_AVERAGE, WINDOW_START, Estimator
from armperturb.commands.command import Command, Positional, command_line
from armperturb.extras import MissingExtraError, naming_the_extra
from armperturb.files import earlier_removed, endings_of, require_new_results
from armperturb.progress import Progress

if TYPE_CHECKING:
    import xarray as xr

    from armperturb.analysis.fit.structures import Structure
    from armperturb.analysis.fit.use_emg import UseOfEmg
    from armperturb.analysis.page.page import Origin

Model = Literal["1", "2", "3", "4", "5", "6", "3a", "3b", "nonlinear", "joint"]
RESULTS = (
    "identify.html",
    "admittance.csv",
    "parameters.csv",
    "endpoint.csv",
    "endpoint.svg",
    "correlations.csv",
    "predictions.csv",
    "pulses.svg",
    "joint.svg",
    "fit.json",
    "structure.toml",
    "structure_*.toml",
    "arm.toml",
    "arm_*.toml",
)
"""Files that are written; * is a condition."""

OF_A_STRUCTURE = ("free", "fix", "bounds", "tie", "prior")
OF_BOTH_ARM_MODELS = ("free", "window_start", "period")
OF_LINEAR_MODELS = ("estimator", "share", "lines_per_average", "body", "window_start", "period", *OF_A_STRUCTURE)
OF_THE_NONLINEAR_MODEL = ("law", "pulses")
OF_THE_JOINT_MODEL = ("reflex", "short_range", "fit_until", "longest_delay")

NO_EMG = "EMG is not used: the joint model takes torque and angle alone; the movement alone is used"


@dataclass(frozen=True, kw_only=True)
class Identify(Command):
    """Estimate the admittance from a recording and fit an arm model to it."""

    recordings: Positional[tuple[Path, ...]]
    """Recordings of one person to read: netCDF4, or CSV, MATLAB, NPZ or C3D with a sidecar (see convert); trials of a
    condition are identified together."""
    out: Path
    """Folder for identify.html, which tells all, admittance.csv, parameters.csv, fit.json, structure.toml, the fitted
    arm in arm.toml (with rigid segments where some have its joint inertia, as simulate and live need), and stiffness,
    damping and inertia at the hand in endpoint.csv and endpoint.svg; of the nonlinear model, for identify.html,
    parameters.csv, correlations.csv, predictions.csv, fit.json and pulses.svg, and for checkpoints from which an
    interrupted search continues."""
    model: str | None = None
    """Model structure; by default the trials of each condition choose it. 1 intrinsic and grip; 2 with velocity, 3 with
    velocity and position feedback; 4, 5 and 6 with force, acceleration or both in addition; 3a and 3b total mass and
    reflexes, with grip, delay and cut-off fixed, 3b without negative gains; FILE.toml a structure of one's own, see
    docs/method.md; nonlinear a muscle law, from all trials of one or both tasks together; joint intrinsic and reflex
    path of a recording of one axis, for which it is the default."""
    sidecar: Path | None = None
    """Sidecar of all recordings that need one, see docs/recordings.md; by default FILE.json beside each."""
    law: Literal["full", "half-wave", "short-range", "linear", "choose"] | None = None
    """Of the nonlinear model: the full muscle law (the default), the same with half-wave rectified spindles that have a
    threshold, short-range stiffness with yielding alone, the linear law, or whichever predicts trials that were left
    out of the fits best (choose)."""
    pulses: tuple[float, ...] = ()
    """Directions of the pulses that the nonlinear model is fitted to [deg], e.g. 20 200; the others are predicted."""
    reflex: Literal["none", "linear", "half-wave"] | None = None
    """Of the joint model: how its reflex answers to velocity; by default left-out data choose."""
    short_range: bool = False
    """Of the joint model: whether its intrinsic path has short-range stiffness."""
    fit_until: float | None = None
    """Of the joint model: end of what is fitted [s]; what follows is predicted from the input alone."""
    longest_delay: float = 0.2
    """Of the joint model: longest delay of its reflex [s]."""
    estimator: Estimator = "record"
    """Maximum likelihood on whole records (record) or on mean periods (frequency), or the thesis's trial by trial."""
    free: tuple[str, ...] = ()
    """Parameters to estimate in addition, e.g. zeta_act, or (with --fix m=0) i_s=0.05:1 within these bounds; by default
    within the bounds of human arms. Of the nonlinear model, in the position task: Td, fact or both, delay of reflexes
    and cut-off of the activation, which are 30 ms and 3.5 Hz otherwise."""
    fix: tuple[str, ...] = ()
    """Parameters to hold, e.g. k_h=rigid Td=0.03; the name of a quantity is that of its parameters at all joints."""
    bounds: tuple[str, ...] = ()
    """Bounds of parameters that are estimated, e.g. fact=1:6."""
    tie: tuple[str, ...] = ()
    """Parameters that follow others, e.g. Td_e=Td_s, m_h=0.49*m_tot."""
    prior: tuple[str, ...] = ()
    """What is known beside the trials, mean and standard deviation, e.g. m_f=1.8+-0.3; with maximum likelihood only."""
    body: tuple[Literal["male", "female"], float, float] | None = None
    """Sex, height [m] and body mass [kg]: what tables (de Leva 1996) tell of the joint inertia becomes a prior; needs
    --fix m=0 --free i, or a model that has them."""
    share: tuple[str, ...] = ()
    """Parameters that are the same in all conditions, e.g. mass grip k_s; with maximum likelihood only."""
    emg: bool = False
    """Use EMG as well: of reflexes it tells more than the movement. Trials of a condition MVC, a maximal contraction,
    are what amplitudes are relative to. Where EMG is missing or cannot be used, as of one axis, the movement alone is.
    The nonlinear model then estimates the delay of reflexes too."""
    emg_delay: tuple[float, float] = (0.0, 0.0)
    """Mean and standard deviation of the time by which muscles answer later than their EMG, beyond the activation
    dynamics [s]; with --emg. What neural and electromechanical delay add up to is all that a movement tells. With the
    nonlinear model it must be known: a standard deviation of 0."""
    subject: str | None = None
    """Which subject, if the recordings hold several."""
    condition: str | None = None
    """The only condition to identify; by default all in which something perturbs the window, of any task."""
    window_start: float = WINDOW_START
    """Start of the window of whole periods [s], when the transient has died away."""
    period: float | None = None
    """Period of the perturbation [s]; by default it is found from the data."""
    lines_per_average: int = LINES_PER_AVERAGE
    """Adjacent excited lines that are averaged in admittance.csv and by the thesis's estimator; 1 keeps every line and
    needs several trials."""
    overwrite: bool = False
    """Replace results of an earlier run in the folder, and remove those that this one does not have; an input is never
    replaced."""

    @property
    def resumes(self) -> bool:
        """Only the search of the nonlinear model writes checkpoints."""
        return self.model == "nonlinear"

    def run(self) -> list[str]:
        """Identify the arm and write the results."""
        from armperturb.commands.selection import MemoryPerSample, select_trials

        self._require_options(("nonlinear", "joint") if self.model is None else (self.model,))
        if self.emg_delay != (0.0, 0.0) and not self.emg:
            raise ValueError(f"identify: emg_delay = {self.emg_delay!r} without EMG; expected it with --emg only")
        if self.model == "nonlinear" and self.emg_delay[1] != 0.0:
            raise ValueError(
                f"identify: emg_delay = {self.emg_delay!r} with --model nonlinear; expected a known one (--emg-delay "
                f"{self.emg_delay[0]:g} 0)"
            )
        if self.emg and self.estimator == "thesis":
            raise ValueError("identify: EMG with estimator = 'thesis'; expected --estimator record or frequency")
        recordings, notes = select_trials(
            self.recordings,
            self.sidecar,
            self.subject,
            self.condition,
            single_condition=self.model == "joint",
            optional=("scheduling", "joint_angle") if self.emg else ("scheduling",),
        )
        kind = self._kind(recordings)
        self._require_options((kind,))
        structure = self._structure() if kind == "linear" else None
        require_new_results(self.out, RESULTS, overwrite=self.overwrite)
        if self.resumes and self.out.exists() and not self.out.is_dir():
            raise ValueError(f"{self.out} is a file; expected a folder, or a new name for one")
        try:
            with earlier_removed(self._earlier_results()):
                if kind == "joint":
                    notes += [NO_EMG] * self.emg
                    lines = self._identify_joint(recordings, notes)
                elif kind == "nonlinear":
                    lines = self._identify_nonlinear(recordings, notes)
                else:
                    MemoryPerSample(longest=2000, all=300).require(recordings)
                    lines = self._identify(recordings, structure, notes)
        except ValueError as error:
            raise ValueError(f"{', '.join(map(str, self.recordings))}: {error}") from None
        return [*notes, *lines, f"results: {self.out}"]

    def _earlier_results(self) -> list[Path]:
        """Files that an earlier run has written to the folder, as its fit.json shows; none where there is no such."""
        summary = self.out / "fit.json"
        try:
            content = json.loads(summary.read_text(encoding="utf-8")) if summary.is_file() else None
        except ValueError:
            content = None
        if not isinstance(content, dict):
            return []
        # Of several conditions it has an object each. What else * stands for may be a person of the user's.
        conditions = [] if isinstance(content.get("model"), str) else endings_of(content).values()
        texts = {name: conditions if "*" in name else [""] for name in RESULTS}
        return [self.out / name.replace("*", text) for name, each in texts.items() for text in each]

    def _require_options(self, models: tuple[str, ...]) -> None:
        """Refuse options of models other than these."""
        of_models = {"nonlinear": OF_THE_NONLINEAR_MODEL, "joint": OF_THE_JOINT_MODEL}
        others = {name: kind for kind, names in of_models.items() if kind not in models for name in names}
        if not {*models} - {*of_models}:
            others |= dict.fromkeys(OF_LINEAR_MODELS, "") if "joint" not in models or len(models) == 1 else {}
        if "nonlinear" in models:
            others = {name: kind for name, kind in others.items() if name not in OF_BOTH_ARM_MODELS}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in others and value != field.default:
                where = f"without --model {others[field.name]}" if others[field.name] else f"with --model {models[0]}"
                raise ValueError(f"identify: {field.name} = {value!r}; expected {field.default!r} {where}")

    def _kind(self, recordings: "list[xr.Dataset]") -> str:
        """Nonlinear, joint or linear, as the model says, or by the axes of the recordings."""
        from armperturb.recording import is_one_axis

        if self.model not in (None, "joint") and is_one_axis(recordings[0]):
            raise ValueError(f"identify: model = {self.model!r} of a recording of one axis; expected joint")
        if self.model is None:
            return "joint" if is_one_axis(recordings[0]) else "linear"
        return self.model if self.model in ("joint", "nonlinear") else "linear"

    def _identify_joint(self, recordings: "list[xr.Dataset]", notes: list[str]) -> list[str]:
        from armperturb.analysis.joint.export import write_joint
        from armperturb.analysis.joint.identify import identify_joint
        from armperturb.analysis.page.joint_page import write_joint_page
        from armperturb.joined_recordings import join_recordings

        result = identify_joint(
            recordings[0] if len(recordings) == 1 else join_recordings(recordings, optional=["scheduling"]).recording,
            reflex=self.reflex,
            short_range=self.short_range,
            fit_until=self.fit_until,
            longest_delay=self.longest_delay,
        )
        write_joint(result, self.out)
        write_joint_page(result, self.out / "identify.html", self._origin(notes))
        return result.summary().splitlines()

    def _structure(self) -> "Structure | None":
        """The structure that is asked for; None if the trials are to choose it."""
        from armperturb.analysis.fit.own_structures import load_structure, with_options
        from armperturb.analysis.fit.structures import structure_of

        if self.model is None:
            for kind in (*OF_A_STRUCTURE, "body"):
                if getattr(self, kind):
                    raise ValueError(
                        f"identify: {kind} = {getattr(self, kind)!r} without a model; expected the one that it changes "
                        "(e.g. --model 3)"
                    )
            return None
        if self.model.endswith(".toml"):
            base = load_structure(self.model)
        elif self.model in get_args(Model):
            base = structure_of(self.model, wide=self.estimator != "thesis")
        else:
            known = ", ".join(get_args(Model))
            raise ValueError(f"identify: model = {self.model!r}; expected one of {known}, or FILE.toml")
        structure = with_options(base, **{kind: getattr(self, kind) for kind in OF_A_STRUCTURE})
        if self.body and "i_s" not in structure.free:
            raise ValueError(
                f"identify: body = {self.body!r} with model {structure.name}; expected one whose joint inertia is free "
                "(--fix m=0 --free i)"
            )
        if (structure.prior or self.body) and self.estimator == "thesis":
            raise ValueError(
                "identify: prior with estimator = 'thesis', which takes none into account; expected --estimator record"
            )
        return structure

    def _identify(self, recordings: "list[xr.Dataset]", structure: "Structure | None", notes: list[str]) -> list[str]:
        from armperturb.analysis.fit.group import parts_by_condition
        from armperturb.analysis.fit.identify import identify_conditions
        from armperturb.analysis.fit.own_structures import inertia_prior, save_structure
        from armperturb.commands.selection import manipulator

        emg = self._emg(notes) if self.emg else None
        trials = parts_by_condition(recordings)
        if structure and self.body:
            person = next(iter(trials.values()))[0].body
            structure = structure.knowing(**inertia_prior(person, *self.body)).named(
                f"{structure.name}, body from tables"
            )
        with Progress("identification", total=len(trials), unit="conditions") as bar:
            results = identify_conditions(
                trials,
                structure,
                estimator=self.estimator,
                share=self.share,
                window_start=self.window_start,
                period=self.period,
                lines_per_average=self.lines_per_average,
                emg=emg,
                progress=lambda _: bar.update(),
            )
        # What draws is loaded only now, as it takes memory that fits of long trials need.
        from armperturb.analysis.fit.export import write_arm, write_identification
        from armperturb.analysis.page.page import write_page

        write_identification(results, self.out)
        endings, lines, unusable = endings_of(results), [], []
        for condition, result in results.items():
            choice = result.fit.choice
            chosen = structure if choice is None else choice.chosen.structure
            name = "structure.toml" if structure or len(results) == 1 else f"structure_{endings[condition]}.toml"
            if chosen is not None:
                save_structure(chosen, self.out / name)
            name = "arm.toml" if len(results) == 1 else f"arm_{endings[condition]}.toml"
            refusal = write_arm(result.fit.arm, self.out / name)
            lines.append(f"{condition}: {manipulator(result.environment)}")
            lines.append(f"{condition}: {result.fit.message}; VAF x {result.vaf[0]:.1f} %, y {result.vaf[1]:.1f} %")
            unusable += [f"{condition}: {name} cannot be simulated: {refusal}"] if refusal else []
        write_page(
            results, trials, self.out / "identify.html", self._origin(notes, emg), emg.envelopes if emg else None
        )
        return [*lines, *results.remarks, *unusable]

    def _origin(self, notes: list[str], emg: "UseOfEmg | None" = None) -> "Origin":
        """What the page says of where its results come from."""
        from armperturb.analysis.page.page import Origin
        from armperturb.commands.selection import with_emg_files
        from armperturb.files import checksum

        files = with_emg_files(self.recordings, self.sidecar) if emg else self.recordings
        return Origin(
            command=command_line(self),
            files={str(path): checksum(path) for path in files},
            notes=tuple(notes),
            window_start=self.window_start,
            period=self.period,
        )

    def _emg(self, notes: list[str]) -> "UseOfEmg | None":
        """EMG of all conditions of the person; None, and a note, where it is missing or cannot be used."""
        from armperturb.analysis.emg.envelope import MAXIMAL, REST, envelopes, remark_on_duration, require_emg
        from armperturb.analysis.emg.outputs import require_known_muscles
        from armperturb.analysis.fit.emg_likelihood import ElectromechanicalDelay
        from armperturb.analysis.fit.use_emg import UseOfEmg
        from armperturb.commands.selection import select_trials
        from armperturb.joined_recordings import join_recordings, of_one_length

        delay = ElectromechanicalDelay(mean=self.emg_delay[0], sd=self.emg_delay[1])
        try:
            recordings, _ = select_trials(
                self.recordings, self.sidecar, self.subject, None, single_condition=False, optional=("emg",)
            )
            for recording in recordings:
                require_emg(recording)
            recordings = of_one_length(recordings, (MAXIMAL, REST))
            joined = recordings[0]
            if len(recordings) > 1:
                joined, lost = join_recordings(recordings, optional=("emg",))
                if lost.get("emg"):
                    raise ValueError(
                        f"EMG is not used: the files differ in it ({lost['emg']}); expected the same muscles, rate and "
                        "filters in all files"
                    )
            del recordings
            result = envelopes(joined[["perturbation", "emg"]].drop_vars("emg_time"))
            require_known_muscles(result)
        except (ValueError, TypeError, OSError) as error:
            notes.append(f"{error}; the movement alone is used")
            return None
        if remark := remark_on_duration(joined):
            notes.append(remark)
        notes.extend(result.remarks)
        return UseOfEmg(envelopes=result, delay=delay)

    def _identify_nonlinear(self, recordings: "list[xr.Dataset]", notes: list[str]) -> list[str]:
        with naming_the_extra("identify --model nonlinear"):
            from armperturb.analysis.nonlinear.export import write_nonlinear
            from armperturb.analysis.nonlinear.identify import identify_nonlinear
            from armperturb.analysis.page.nonlinear_page import write_nonlinear_page
            from armperturb.workers import cpu_count
        from armperturb.analysis.fit.group import parts_by_condition
        from armperturb.joined_recordings import join_recordings
        from armperturb.plots.style import save_plot

        emg = self._emg(notes) if self.emg else None
        is_new = not self.out.exists()
        self.out.mkdir(parents=True, exist_ok=True)  # now, as checkpoints go there
        try:
            result = identify_nonlinear(
                recordings[0]
                if len(recordings) == 1
                else join_recordings(recordings, optional=("joint_angle",)).recording,
                self.law or "full",
                pulse_directions_deg=self.pulses,
                window_start=self.window_start,
                period=self.period,
                folder=self.out,
                progress=lambda line: print(line, file=sys.stderr, flush=True),
                threads=cpu_count(),
                emg=emg.envelopes if emg else None,
                emg_delay=self.emg_delay[0],
                free=self.free,
            )
        except (ValueError, MissingExtraError):
            if is_new and not any(self.out.iterdir()):
                self.out.rmdir()
            raise
        if result.pulses["nonlinear"]:
            save_plot(result, self.out / "pulses.svg")
        write_nonlinear(result, self.out)
        trials = parts_by_condition(recordings)
        write_nonlinear_page(result, trials, self.out / "identify.html", self._origin(notes, emg))
        return result.summary().splitlines()
