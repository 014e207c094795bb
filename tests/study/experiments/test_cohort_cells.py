"""Cells of a cohort whose recordings are not kept, against those of a study that keeps them."""

from dataclasses import replace

import numpy as np
import pytest

from armperturb.recording_files import load_recording
from armperturb.study.experiments.cohort_cells import measure_cohort
from armperturb.study.recording.record import record_study
from armperturb.study.results.quantities import measured_cells, published_cells
from tests.recorded import cells_of_cohort, cohort


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return cohort(tmp_path_factory.mktemp("cohort"))


@pytest.fixture(scope="module")
def alone(once):
    return once("cohort", cells_of_cohort)


@pytest.mark.slow(reason="simulates and analyses a cohort twice")
def test_cells_are_those_of_a_study_to_the_last_bit(settings, alone, tmp_path):
    files = record_study(settings, tmp_path, show_progress=False)
    assert alone.index.tolist() == [path.stem for path in files]
    assert alone.columns.tolist() == [*published_cells()]
    for path in files:
        cells = measured_cells(load_recording(path))
        assert len(cells) > 20
        printed = {cell: value for cell, value in cells.items() if cell in published_cells()}
        assert alone.loc[path.stem].dropna().to_dict() == printed


@pytest.mark.slow(reason="simulates a cohort")
def test_a_larger_cohort_begins_with_the_same_people(settings, alone):
    first = measure_cohort(replace(settings, subjects=1), workers=1, show_progress=False)
    np.testing.assert_array_equal(first, alone[:1])


@pytest.mark.slow(reason="starts a Dask cluster")
def test_a_dask_cluster_gives_the_same_cells(settings, alone):
    """Its worker is a thread, which starts sooner than a process; all goes through the network."""
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": None, "silence_logs": 50}
    with distributed.LocalCluster(processes=False, protocol="tcp", **options) as cluster:
        assert measure_cohort(settings, dask=cluster.scheduler_address, show_progress=False).equals(alone)


def test_bad_input_is_named(settings):
    with pytest.raises(ValueError, match=r"cohort: workers = 0; expected .* at least 1"):
        measure_cohort(settings, workers=0)
