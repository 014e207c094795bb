"""The walk of a person's recording through the analysis: nothing is prepared twice."""

from collections import Counter
from pathlib import Path

import pytest

from armperturb import recording as recordings
from armperturb import recording_files
from armperturb.analysis import periods, trials
from armperturb.analysis.force_balance import Balance
from armperturb.analysis.response import spectra
from armperturb.recording_files import load_recording, save_recording
from armperturb.study.protocol import Condition, Protocol
from armperturb.study.results.person import analyse_person
from armperturb.study.results.settings import AnalysisSettings

CONDITIONS = {"RT7.5": 0.0075, "RT22.5": 0.0225}


@pytest.mark.slow(reason="analyses a person")
def test_trials_are_checked_cut_and_identified_once(noisy_relax_recording, tmp_path, monkeypatch):
    save_recording(noisy_relax_recording, tmp_path / "S.nc")
    counts = Counter()

    def count(owner, name, *others):
        function = getattr(owner, name)

        def counted(*arguments, **options):
            counts[name] += 1
            return function(*arguments, **options)

        for place in (owner, *others):
            monkeypatch.setattr(place, name, counted)

    count(recordings, "check_recording", recording_files, trials)
    count(periods, "find_period")
    count(spectra, "estimate_spectra")
    count(Balance, "fit")
    protocol = Protocol(
        conditions=tuple(
            Condition(name=name, task="RT", rms_displacement=rms, published_force=1.0)
            for name, rms in CONDITIONS.items()
        )
    )
    results = analyse_person(
        load_recording(tmp_path / "S.nc", ["joint_angle"]),
        Path("S.nc"),
        protocol,
        AnalysisSettings(structures=("1",), starts_of=None),
    )
    assert all(case.identification is not None and case.thesis is not None for case in results.cases)
    assert results.fits.first.keys() == {("RT7.5", "1")}
    n_trials = noisy_relax_recording.sizes["trial"]
    assert counts == {
        "check_recording": 1,
        "find_period": len(CONDITIONS),
        "fit": len(CONDITIONS),
        "estimate_spectra": len(CONDITIONS) + n_trials,  # averaged over the trials, and of each of them
    }
