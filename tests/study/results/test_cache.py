"""Results that are kept: what they depend on, and why one is not used."""

from dataclasses import replace

import pytest

from armperturb.archive import write_archive
from armperturb.progress import Progress
from armperturb.study.published.tables import MeanSD
from armperturb.study.results.cache import (
    VERSIONS,
    CachedResult,
    StaleResult,
    Unit,
    forget_results,
    kept_or_computed,
    recalled_numbers,
    recalled_results,
    reusable,
)


def cached(path, **changes):
    settings = {"fitted_deg": (20.0,), "models": {"RT7.5": "1"}}
    options = {"kind": "person", "recordings": {"S01.nc": "12ab"}, "settings": settings, **changes}
    return CachedResult(path=path / "folder" / "a.json.gz", result=MeanSD, **options)


def results(*units):
    bar = Progress("test", total=len(units), unit="units", show=False)
    return kept_or_computed(units, None, bar)


def test_a_result_depends_on_recordings_settings_and_version_alone(tmp_path):
    assert cached(tmp_path).source == {
        "kind": "person",
        "version": VERSIONS["person"],
        "recordings": {"S01.nc": "12ab"},
        "settings": {"fitted_deg": [20.0], "models": {"RT7.5": "1"}},
    }
    assert cached(tmp_path).read() is None
    cached(tmp_path).write(MeanSD(1.0, 2.0))
    assert cached(tmp_path).read() == (1.0, 2.0)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"recordings": {"S01.nc": "34cd"}}, r"the recording has changed since \(S01.nc\)"),
        ({"recordings": {"S01.nc": "12ab", "S02.nc": "56ef"}}, r"the recording has changed since \(S02.nc\)"),
        ({"recordings": {}}, r"the recording has changed since \(S01.nc\)"),
        (
            {"settings": {"fitted_deg": (200.0,), "models": {"RT7.5": "1"}}},
            r"it was made with other settings: fitted_deg\[0\] is 20.0 there and 200.0 now",
        ),
        (
            {"settings": {"fitted_deg": (20.0,), "models": {}}},
            r'it was made with other settings: models.RT7.5 is "1" there and missing now',
        ),
        ({"kind": "nonlinear"}, "it does not say what it was made from"),
    ],
)
def test_a_stale_result_says_what_has_changed(tmp_path, changes, reason):
    cached(tmp_path).write(MeanSD(1.0, 2.0))
    with pytest.raises(StaleResult, match=f"^{reason}$"):
        cached(tmp_path, **changes).read()
    assert results(Unit(cached=cached(tmp_path, **changes), run=lambda: MeanSD(3.0, 4.0))) == [(3.0, 4.0)]
    assert cached(tmp_path, **changes).read() == (3.0, 4.0)


def test_a_raised_version_makes_results_stale(tmp_path, monkeypatch):
    cached(tmp_path).write(MeanSD(1.0, 2.0))
    monkeypatch.setitem(VERSIONS, "nonlinear", 99)
    assert cached(tmp_path).read() == (1.0, 2.0)
    version = VERSIONS["person"]
    monkeypatch.setitem(VERSIONS, "person", 99)
    with pytest.raises(StaleResult, match=rf"^it was made by version {version} of the algorithm, which is now at 99$"):
        cached(tmp_path).read()


def test_what_is_no_such_result_is_stale(tmp_path):
    (tmp_path / "folder").mkdir()
    for source, reason in (
        (None, "it does not say what it was made from"),
        (cached(tmp_path).source, "it holds a float"),
    ):
        write_archive(cached(tmp_path).path, source, 1.0)
        with pytest.raises(StaleResult, match=reason):
            cached(tmp_path).read()
    cached(tmp_path).path.write_bytes(b"no archive")
    with pytest.raises(StaleResult, match=r"^it cannot be read \(error: "):
        cached(tmp_path).read()


def test_a_folder_that_cannot_be_written_to_is_warned_of(tmp_path, caplog):
    (tmp_path / "folder").write_text("")
    assert results(Unit(cached=cached(tmp_path), run=lambda: MeanSD(1.0, 2.0))) == [(1.0, 2.0)]
    assert "cannot be written" in caplog.text


def test_what_is_missing_is_computed_and_only_results_are_kept(tmp_path):
    places = [replace(cached(tmp_path), path=tmp_path / f"{n}.json.gz") for n in range(3)]
    places[1].write(MeanSD(1.0, 2.0))
    computed = [MeanSD(0.0, 0.0), MeanSD(3.0, 3.0), "a reason"]
    units = [Unit(cached=place, run=lambda value=value: value) for place, value in zip(places, computed, strict=True)]
    assert results(*units) == [(0.0, 0.0), (1.0, 2.0), "a reason"]
    assert [place.read() for place in places] == [(0.0, 0.0), (1.0, 2.0), None]


def test_recalled_results_are_named_and_forgotten_where_that_is_asked_for(tmp_path):
    (tmp_path / "analysis").mkdir()
    names = ("S01.json.gz", "S01-nonlinear-RT.json.gz", "S01-nonlinear-PT-20.json.gz")
    files = [CachedResult(path=tmp_path / "analysis" / name, kind="person", result=MeanSD) for name in names]
    for each in files:
        each.write(MeanSD(1.0, 2.0))
    with recalled_results() as recalled:
        reusable(files)
        assert recalled_numbers() == ["S01", "S01-nonlinear-PT-20", "S01-nonlinear-RT"]
    assert [path.name for path in recalled] == list(names)
    assert recalled_numbers() == []
    forget_results(tmp_path, ["RT"])
    assert [path.name for path in (tmp_path / "analysis").iterdir()] == [names[2]]
