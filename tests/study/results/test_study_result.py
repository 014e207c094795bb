"""An analysed study: kept and read again, made anew where its sources change, and made of what is there."""

import hashlib
import json
import math
import os
import re
import shutil
from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from invented import people_of, study_of

from armperturb import archive
from armperturb.analysis.results import PARAMETER_COLUMNS
from armperturb.cli import main
from armperturb.recording_files import load_recording, save_recording
from armperturb.study.comparison.effects import effects
from armperturb.study.comparison.score import score, share
from armperturb.study.protocol import THESIS
from armperturb.study.report import report
from armperturb.study.report.figures.catalogue import drawings
from armperturb.study.results import analyse, person
from armperturb.study.results.analyse import analyse_study
from armperturb.study.results.appendix_fits import Fits, SecondStep
from armperturb.study.results.person import PersonResults, missing_trials
from armperturb.study.results.quantities import Cell
from armperturb.study.results.recordings import load_trials
from tests.differences import differences
from tests.studies import FEW_FITS, sketch

COMPUTING = ("analyse_person", "fit_second_step")


@pytest.fixture(scope="module")
def folder(study):
    return study.of("PT7.5")[0].recording.parents[1]


def copy_of(folder, root):
    """A copy of a study with its analysis; its recordings are links, to be replaced and not written to."""
    shutil.copytree(folder, root, ignore=shutil.ignore_patterns("*.nc", ".lock"))
    for path in (folder / "recordings").glob("*.nc"):
        os.link(path, root / "recordings" / path.name)
    return root


@pytest.fixture
def copied(folder, tmp_path):
    return copy_of(folder, tmp_path / "copied")


@pytest.fixture(scope="module")
def lacking(folder, tmp_path_factory):
    """A copy in which S02 lacks conditions."""
    root = copy_of(folder, tmp_path_factory.mktemp("lacking") / "copied")
    path = root / "recordings" / "S02.nc"
    replaced(path, of_conditions(load_recording(path), "PT0", "PT7.5"))
    return root


@pytest.fixture
def asked(monkeypatch):
    """What is computed, as (function, person); the rest was kept."""
    calls = []

    def watched(name, function):
        def call(recording, *rest):
            trials = next(iter(recording.values())).recording if isinstance(recording, dict) else recording
            calls.append((name, str(trials["subject"].values[0])))
            return function(recording, *rest)

        return call

    for name in COMPUTING:
        monkeypatch.setattr(analyse, name, watched(name, getattr(analyse, name)))
    return calls


def refuse(*_):
    raise ValueError("asked to analyse")


def analysed(root, settings=FEW_FITS):
    return analyse_study(root, workers=1, settings=settings, show_progress=False)


def replaced(path, recording):
    """Another recording under the name of one that is there, with its checksum."""
    path.unlink()
    save_recording(recording, path)
    sums = path.parent / "SHA256SUMS"
    of = dict(reversed(line.split("  ")) for line in sums.read_text().splitlines())
    of[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    sums.write_text("".join(f"{value}  {name}\n" for name, value in of.items()))


def of_conditions(recording, *names):
    """The trials of some conditions, as each takes its time to be identified in."""
    return recording.isel(trial=np.flatnonzero(np.isin(recording["condition"].values, names)))


def changed_manifest(root, **changes):
    path = root / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def cells_of(study):
    return {one.cell: one for one in score(study).cells}


def test_what_is_kept_is_what_was_computed(thesis_study, asked):
    again = analysed(thesis_study.cases[0].recording.parents[1], replace(FEW_FITS, starts_of="PT7.5"))
    assert asked == []
    assert differences(again, thesis_study) == []
    assert (len(again.people), len(again.cases)) == (3, 3 * 6)
    assert (len(again.appendices.first), len(again.appendices.second)) == (2, 6)
    assert len(again.appendices.starts) > 6
    assert [(each.name, each.shown is not None) for each in again.emg] == [
        ("S01", True),
        ("S02", False),
        ("S03", False),
    ]


def test_other_recordings_and_settings_are_analysed_anew(lacking, asked, monkeypatch):
    found = analysed(lacking)
    # Step 2 of appendix C follows from everybody.
    assert [name for name, person in asked if person == "S01"] == ["fit_second_step"]
    assert sorted(name for name, person in asked if person == "S02") == sorted(COMPUTING)
    assert found.missing == tuple(
        f"S02 has 0 of {number} trials in {name}" for name, number in (("PT2.5", 1), ("RT7.5", 2), ("RT22.5", 1))
    )
    assert [case.name for case in found.of("RT22.5")] == ["S01"]
    one = cells_of(found)[Cell("2.1", "RT22.5", "rms_force")]
    assert one.ours.mean == pytest.approx(found.of("RT22.5")[0].force)
    assert math.isnan(one.ours.sd)

    asked.clear()
    analysed(lacking)
    assert asked == []
    monkeypatch.setattr(analyse, "analyse_person", refuse)
    with pytest.raises(ValueError, match=r"S01\.nc: asked to analyse"):
        analysed(lacking, replace(FEW_FITS, structures=()))


def test_people_without_a_whole_recording_are_told(study, copied, tmp_path):
    path = copied / "recordings" / "S02.nc"
    content = path.read_bytes()
    path.unlink()
    incomplete = "the study is incomplete: 1 of 2 people have no whole recording (S02)"
    for is_there, first in ((False, incomplete), (True, "S02.nc does not match its checksum; it is left out")):
        if is_there:
            path.write_bytes(content[: len(content) // 2])
        found = analysed(copied)
        assert found.missing[0] == first
        assert incomplete in found.missing
        assert found.names == ("S01",)
        assert found.n_people == 2
        # What was kept of who is left is used.
        assert differences(found.people[0], study.people[0]) == []
        result = score(found)
        assert result.people == 1
        assert incomplete in result.remarks
    text = sketch(replace(found, people=()), tmp_path / "report")
    assert 0 < text.index("S02.nc does not match its checksum") < text.index(incomplete) < text.index("<section")


def test_nobody_in_a_condition_is_not_reproduced(study, lacking, tmp_path):
    copied = copy_of(lacking, tmp_path / "copied")
    (copied / "recordings" / "S01.nc").unlink()
    found = analysed(copied)
    cells = [one for one in cells_of(found).values() if one.cell.condition == "RT22.5"]
    assert {one.reason for one in cells} == {"RT22.5 was not recorded"}
    assert share(cells).computed == 0
    assert share(cells).parts == (0.0, 0.0, 0.0)
    whole, partial = (share(score(one).cells) for one in (study, found))
    assert partial.published == whole.published
    assert partial.computed < whole.computed
    text = sketch(found, tmp_path / "report")
    assert "<li>S02 has 0 of 1 trials in RT22.5</li>" in text
    assert "1 of 2 people have no whole recording (S01)</li>" in text
    assert "RT22.5 was not recorded" in text


def test_manifests_of_other_versions_are_told(study, copied, asked, tmp_path):
    versions = json.loads((copied / "manifest.json").read_text())["versions"]
    changed_manifest(copied, versions={**versions, "mujoco": "1.2.3"})
    found = analysed(copied)
    line = f"the recordings were made with other versions: mujoco 1.2.3, now {versions['mujoco']}"
    assert found.missing == (line,)
    assert differences(found.people, study.people) == []
    assert found.has_truth
    assert line in sketch(replace(found, people=()), tmp_path / "report")

    changed_manifest(copied, people="others")
    found = analysed(copied)
    assert "this version draws other people than those who were recorded" in found.missing[1]
    assert found.cohort == ()
    assert not found.has_truth
    assert asked == []
    assert differences(score(found).cells, score(study).cells) == []


def test_without_a_manifest_conditions_are_the_thesiss_of_the_same_names(study, copied, asked, tmp_path):
    without_manifest(copied, ("PT0", "PT7.5", "RT22.5"))
    found = analysed(copied)
    assert len(asked) == len(COMPUTING)
    assert (found.made, found.cohort) == (None, ())
    counts = Counter(load_recording(copied / "recordings" / "S01.nc")["condition"].values.tolist())
    assert found.recorded == counts
    # Levels and directions are those that were recorded.
    levels = {each.name: each.pulse_levels for each in study.protocol.conditions}
    of_thesis = [each for each in THESIS.conditions if each.name in counts]
    # What was intended nobody knows: movements are those that people reached.
    reached = {case.condition.name: case.displacement for case in found.cases if np.isfinite(case.displacement)}
    moved = {name: {"rms_displacement": value, "reached": 1.0} for name, value in reached.items()}
    assert found.protocol.conditions == tuple(
        replace(each, pulse_levels=levels[each.name], **moved.get(each.name, {})) for each in of_thesis
    )
    assert found.protocol.pulse_directions_deg == (20.0,)
    assert found.environment.m_env == pytest.approx(study.environment.m_env, rel=0.02)
    assert "how the recordings were made is not known" in found.missing[0]
    assert found.n_people == 1
    # The same multisines tell the same.
    mine, known = found.of("PT7.5")[0], study.of("PT7.5")[0]
    assert mine.identified.fit.values == known.identified.fit.values
    assert mine.truth is None
    assert cells_of(found)[Cell("2.1", "PT7.5", "rms_force")].ours.mean == pytest.approx(mine.force)
    page = sketch(found, tmp_path / "report")
    assert f"{len(counts)} conditions" in " ".join(page.split())
    assert f"{counts.total()} trials in all" in page
    text = " ".join(page.split())
    assert "The hand holds the manipulator, which pushes it" in text
    assert "beside what the simulated joints really did" in text  # as these recordings hold them

    for content, message in (("{", "not readable as JSON"), ("[]", "holds a list"), ("{}", "no 'versions'")):
        (copied / "manifest.json").write_text(content)
        again = analysed(copied)
        assert message in again.missing[0]
        assert again.protocol == found.protocol
        assert differences(again.people, found.people) == []
    assert len(asked) == len(COMPUTING)


def without_manifest(copied, kept, names=None):
    """Make of a copied study one without a manifest: one person in some conditions, which may be called otherwise."""
    path = copied / "recordings" / "S01.nc"
    recording = of_conditions(load_recording(path), *kept)
    labels = [(names or {}).get(name, name) for name in recording["condition"].values.tolist()]
    for each in ("manifest.json", "recordings/SHA256SUMS", "recordings/S02.nc", "recordings/S01.nc"):
        (copied / each).unlink()
    save_recording(recording.assign_coords(condition=("trial", labels)), path)
    return labels


def test_conditions_with_names_of_ones_own_are_what_their_trials_show(study, copied, monkeypatch, tmp_path):
    names = {"PT7.5": "hold", "RT22.5": "let go", "PT0": "pushed"}
    labels = without_manifest(copied, names, names)
    found = analysed(copied)
    assert found.recorded == Counter(labels)
    intended = {names.get(each.name, each.name): each for each in study.protocol.conditions}
    own = [each for each in found.protocol.conditions if each.name in names.values()]
    assert [each.name for each in own] == ["hold", "pushed", "let go"]  # position tasks first, multisines first
    for each in own:
        there = intended[each.name]
        assert (each.task, each.has_multisine, each.pulse_levels) == (
            there.task,
            there.has_multisine,
            there.pulse_levels,
        )
    # The same multisines tell the same, whatever they are called.
    for name in ("PT7.5", "RT22.5"):
        mine, known = found.of(names[name])[0], study.of(name)[0]
        assert mine.identified.fit.values == known.identified.fit.values
        assert mine.condition.rms_displacement == pytest.approx(known.displacement)
    assert "hold, pushed, let go are as their trials show" in found.missing[0]
    page = " ".join(sketch(found, tmp_path / "report").split())
    assert f"{len(set(labels))} conditions" in page
    assert "intended [mm]" not in page  # nobody knows


def test_pulses_without_labels_count_as_one_level_in_the_direction_of_their_force(study, copied, tmp_path):
    without_manifest(copied, ("PT7.5", "PT0", "RT22.5"), {"PT7.5": "hold", "PT0": "pushed"})
    path = copied / "recordings" / "S01.nc"
    recording = load_recording(path)
    has_pulse = np.isfinite(recording["pulse_onset"].values)
    told = recording["pulse_direction"].values[has_pulse]
    for level in (0.0, math.nan):
        path.unlink()
        unlabelled = {"pulse_level": np.full(len(has_pulse), level), "pulse_direction": np.full(len(has_pulse), np.nan)}
        save_recording(recording.assign_coords({name: ("trial", its) for name, its in unlabelled.items()}), path)
        labelled = load_trials(path)
        np.testing.assert_array_equal(labelled["pulse_level"].values, np.where(has_pulse, 1.0, 0.0))
        np.testing.assert_allclose(labelled["pulse_direction"].values[has_pulse], told % 360.0, atol=2.5)
    found = analysed(copied)
    assert "; hold, pushed are as their trials show" in found.missing[0]
    assert found.protocol.condition("RT22.5").published_force == THESIS.condition("RT22.5").published_force
    assert found.protocol.condition("pushed").pulse_levels == (1.0,)
    assert found.protocol.pulse_directions_deg == tuple(np.unique(told % 360.0))
    (known,) = (person for person in study.people if person.name == "S01")
    mine = found.people[0].pulses["pushed", "1"]
    same = [trial for trial in known.trials if trial.condition == "PT0"]
    assert mine.displacement == pytest.approx(np.mean([trial.displacement for trial in same]))
    assert any(line.startswith("pulses that have no level") and "pushed" in line for line in found.missing)
    # Their figures are drawn, too.
    drawn = drawings(found, effects(found))
    for name in ("pulse_signal", "pulse_directions", "joint_rotations"):
        drawn[name]()


def test_conditions_without_a_perturbation_are_left_out(copied, monkeypatch):
    monkeypatch.setattr(person, "identify_person", lambda *_: ())  # takes seconds
    without_manifest(copied, ("PT7.5", "PT0", "RT22.5"), {"PT7.5": "rest"})
    path = copied / "recordings" / "S01.nc"
    recording = load_recording(path)

    def at_rest(names, size=0.0):
        still = recording["condition"].isin(names)
        noise = size * np.random.default_rng(0).standard_normal(recording["perturbation"].shape)
        quiet = recording.assign(perturbation=recording["perturbation"].where(~still, noise))
        labels = {"pulse_onset": math.nan, "pulse_level": 0.0, "pulse_direction": math.nan}
        path.unlink()
        save_recording(
            quiet.assign_coords({name: recording[name].where(~still, at) for name, at in labels.items()}), path
        )

    at_rest(["rest"], size=0.01)  # noise of the channel is no perturbation
    found = analysed(copied)
    assert "conditions in which nothing perturbs the handle are left out: rest" in found.missing
    assert "rest" not in found.recorded

    recording = recording.assign_coords(condition=recording["task"])
    at_rest(["PT", "RT"])
    with pytest.raises(ValueError, match=r"no manifest\.json, and nothing perturbs the handle in condition PT, RT"):
        analysed(copied)


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ({"l_h": math.nan}, r"S01\.nc: l_h unknown; expected the person's, which joints and models need"),
        (
            {"task": "RT"},
            r"S01\.nc: task = 'RT' in condition PT\S+; expected 'PT' \(labels\.task of the sidecar, or another ",
        ),
    ],
)
def test_labels_that_cannot_be_are_refused_by_name(copied, monkeypatch, labels, message):
    monkeypatch.setattr(person, "identify_person", lambda *_: ())  # takes seconds
    (copied / "manifest.json").unlink()
    (copied / "recordings" / "SHA256SUMS").unlink()
    path = copied / "recordings" / "S01.nc"
    recording = load_recording(path)
    n_trials = recording.sizes["trial"]
    save_recording(
        recording.assign_coords({name: ("trial", [value] * n_trials) for name, value in labels.items()}), path
    )
    with pytest.raises(ValueError, match=message):
        analysed(copied)


def test_conditions_that_the_protocol_lacks_are_told(study, copied):
    recording = load_recording(copied / "recordings" / "S01.nc")
    labels = ["elsewhere" if name == "RT22.5" else name for name in recording["condition"].values]
    lines = missing_trials(recording.assign_coords(condition=("trial", labels)), study.protocol)
    assert lines == ["S01 has 0 of 1 trials in RT22.5", "S01 was recorded in elsewhere, which the protocol lacks"]


def test_folders_that_cannot_be_written_to_are_analysed(study, copied, monkeypatch, caplog):
    # By hand, as permissions do not bind the administrator, who runs tests in containers.
    def read_only(path, content):
        raise OSError(30, "Read-only file system")

    shutil.rmtree(copied / "analysis")
    (copied / "recordings" / "S02.nc").unlink()
    monkeypatch.setattr(archive, "write_whole", read_only)
    of = {person.name: person for person in study.people}

    def analyse_person(recording, *_):
        name = str(recording["subject"].values[0])
        return PersonResults(cases=(), measures=of[name], fits=Fits(name, {}, {}, ()), missing=())

    monkeypatch.setattr(analyse, "analyse_person", analyse_person)
    monkeypatch.setattr(analyse, "fit_second_step", lambda *_: SecondStep({}, ()))
    found = analysed(copied)
    assert differences(found.people, study.people[:1]) == []
    assert "S01.json.gz cannot be written (Read-only file system): it will be computed again next time" in caplog.text
    assert not list((copied / "analysis").iterdir())


def test_a_recording_of_two_people_is_named(copied, monkeypatch):
    path = copied / "recordings" / "S01.nc"
    recording = load_recording(path)
    names = ["S01"] * (recording.sizes["trial"] - 1) + ["S09"]
    replaced(path, recording.assign_coords(subject=("trial", names)))
    monkeypatch.setattr(person, "identify_person", lambda *_: ())  # takes seconds
    with pytest.raises(ValueError, match=r"S01\.nc: recording: subject = S01, S09; expected one person"):
        analysed(copied)


def test_the_command_reports_on_what_is_there(copied, capsys, monkeypatch):
    whole = report.write_report
    monkeypatch.setattr(report, "write_report", partial(whole, figures=(), simulate=False))
    monkeypatch.setattr(analyse, "analyse_study", lambda folder, **_: analysed(folder))
    assert main(["report", str(copied), "--workers", "1"]) == 0
    recalled, written = capsys.readouterr().out.splitlines()
    assert recalled.startswith("recalled from analysis/ (--fresh computes them anew): S01")
    assert written == f"report: {copied / 'report.html'}"
    numbers = re.search(
        r"Numbers recalled from an earlier analysis(?:.*\n){2}  (.*)\.</p>", (copied / "report.html").read_text()
    )
    assert numbers[1].split(", ")[0] == "S01"
    assert (copied / "score" / "score.csv").is_file()


@pytest.mark.parametrize("command", ["report", "score"])
def test_a_folder_without_recordings_is_one_line(tmp_path, capsys, command):
    assert main([command, str(tmp_path)]) == 1
    [line] = capsys.readouterr().err.splitlines()
    assert line == (
        f"armperturb: error: {tmp_path}: holds no recordings/*.nc; expected the folder of a study (other recordings: "
        "armperturb identify FILES --out DIR)"
    )
    assert not list(tmp_path.iterdir())


def test_bad_numbers_of_workers_are_refused(folder):
    with pytest.raises(ValueError, match="analysis: workers = 0; expected a finite number at least 1"):
        analyse_study(folder, workers=0)
    with pytest.raises(ValueError, match="at least 1 and at most 1000"):
        analyse_study(folder, workers=10**30)
    with pytest.raises(TypeError, match="workers"):
        analyse_study(folder, workers="two")


def test_a_folder_may_be_given_as_text(tmp_path):
    with pytest.raises(OSError, match="expected the folder of a study"):
        analyse_study(str(tmp_path), show_progress=False)


def test_a_person_in_two_files_is_refused_by_name(study, tmp_path, monkeypatch):
    monkeypatch.setattr(person, "identify_person", lambda *_: ())  # takes seconds
    (tmp_path / "recordings").mkdir()
    recording = of_conditions(load_recording(study.of("PT7.5")[0].recording), "PT0")
    for name in ("A.nc", "B.nc"):
        save_recording(recording, tmp_path / "recordings" / name)
    with pytest.raises(ValueError, match=r"A.nc and B.nc are of subject 'S01'; expected one recording per person"):
        analysed(tmp_path, replace(FEW_FITS, structures=()))
    (tmp_path / "recordings" / "B.nc").unlink()
    renamed = recording.assign_coords(subject=("trial", ["S07"] * recording.sizes["trial"]))
    save_recording(renamed, tmp_path / "recordings" / "B.nc")
    with pytest.raises(ValueError, match=r"A.nc and B.nc hold the same trials; expected one recording per person"):
        analysed(tmp_path, replace(FEW_FITS, structures=()))


def test_a_study_of_pulses_alone_has_an_empty_table_and_no_spectra():
    everybody = study_of(people_of())
    pulses = replace(everybody, cases=())
    assert list(pulses.to_frame().columns) == list(PARAMETER_COLUMNS)
    assert len(pulses.to_frame()) == 0
    assert len(pulses.pulses) == 10
    for use in (pulses.to_xarray, pulses.plot):
        with pytest.raises(ValueError, match="nobody was identified in any condition"):
            use()
