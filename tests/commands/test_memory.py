"""Analyses that would take too much memory are refused before they begin, and nothing is read that they do not use."""

import numpy as np
import pytest
import xarray as xr
from laboratory import write

from armperturb.commands.selection import MemoryPerSample
from armperturb.convert.importer import import_recording
from armperturb.recording import MUSCLES
from armperturb.recording_files import save_recording


def of_length(duration, n_trials=1, rate=200.0):
    time = np.broadcast_to(0.0, (n_trials, round(duration * rate), 2))
    return xr.Dataset({"force": (("trial", "time", "axis"), time)}, attrs={"rate": rate})


def test_length_trials_and_memory_are_named():
    needs = MemoryPerSample(longest=2000, all=300)
    needs.require([of_length(3600.0), of_length(36.0, 320)])
    message = r"2 trials of up to 36000 s at 200 Hz take some 15.8 GiB .* at most 4 GiB \(a lower rate .* --rate"
    with pytest.raises(ValueError, match=message):
        needs.require([of_length(36000.0), of_length(36.0)])


@pytest.mark.slow(reason="writes a large recording")
def test_what_an_analysis_does_not_use_is_not_read(tmp_path):
    path = write(tmp_path)
    whole = import_recording([path]).recording
    emg = np.zeros((whole.sizes["trial"], 2400, 8), dtype=np.float32)
    clock = np.arange(2400) / (2.0 * whole.attrs["rate"])
    whole = whole.assign_coords(emg_time=clock, muscle=list(MUSCLES)).assign_attrs(emg_rate=2.0 * whole.attrs["rate"])
    whole["emg"] = ("trial", "emg_time", "muscle"), emg, {"units": "V"}
    save_recording(whole, tmp_path / "r.nc")
    assert "emg" in import_recording([tmp_path / "r.nc"]).recording
    alone = import_recording([tmp_path / "r.nc"], optional=()).recording
    assert not {"emg", "emg_time", "muscle"} & set(alone.variables)
