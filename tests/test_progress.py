"""Progress where there is no terminal: lines in the log, with the time that is left of the whole."""

import time

import pytest

from armperturb.progress import Progress, in_words, stages


def test_lines_tell_what_is_done_and_what_is_left(capsys):
    with stages({"recording": 1.0}, interval=0.05), Progress("recording", total=320, unit="trials") as bar:
        bar.update(138)
        deadline = time.monotonic() + 10.0
        lines = []
        while not lines and time.monotonic() < deadline:
            time.sleep(0.02)
            lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "recording: 43% (138 of 320 trials), 0 s left of the whole"


def test_what_is_left_counts_later_stages(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("armperturb.progress.time.monotonic", lambda: clock[0])
    with stages({"recording": 2.0, "analysis": 1.0, "figures": 1.0}, interval=1e6):
        with Progress("recording", total=10, unit="trials", initial=2) as bar:
            assert bar.line() == "recording: 20% (2 of 10 trials), time left unknown yet"
            clock[0] = 40.0
            bar.update(4)  # half of what was left: 40 s more of 80 s for a share of 1.6, and 100 s for a share of 2
            assert bar.line() == "recording: 60% (6 of 10 trials), 2 min 20 s left of the whole"
            clock[0] = 60.0
            bar.update(2)
            # Two in the last 20 s: 20 s more of 80 s, and 100 s for a share of 2.
            assert bar.line() == "recording: 80% (8 of 10 trials), 2 min 0 s left of the whole"
            clock[0] = 80.0
            bar.update(2)
        # Nothing is to be analysed: figures are what is left, at 50 s for a share of 1.
        with Progress("figures", total=3, unit="units") as bar:
            assert bar.line() == "figures: 0% (0 of 3 units), 50 s left of the whole"


def test_what_was_done_before_tells_nothing_of_the_pace(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("armperturb.progress.time.monotonic", lambda: clock[0])
    with stages({"analysis": 3.0, "fits": 10.0, "figures": 1.0}, interval=1e6):
        with Progress("analysis", total=6, unit="steps") as bar:
            clock[0] = 1.0
            bar.skip(4)  # in a second
            assert bar.line() == "analysis: 67% (4 of 6 steps), time left unknown yet"
            clock[0] = 20.0
            bar.update(1)
            # 20 s for one of six steps, or for a share of 0.5: 20 s more, and 440 s for shares of 11.
            assert bar.line() == "analysis: 83% (5 of 6 steps), 7 min 40 s left of the whole"
            bar.update(1)
        with Progress("fits", total=2, unit="fits") as bar:
            bar.skip(2)
            clock[0] = 21.0
            assert bar.line() == "fits: 100% (2 of 2 fits), 20 s left of the whole"
        with Progress("figures", total=4, unit="figures") as bar:
            assert bar.line() == "figures: 0% (0 of 4 figures), 20 s left of the whole"


def test_of_a_whole_that_was_recalled_no_time_is_invented(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("armperturb.progress.time.monotonic", lambda: clock[0])
    with stages({"analysis": 40.0, "fits": 300.0}, interval=1e6):
        with Progress("analysis", total=30, unit="steps") as bar:
            clock[0] = 2.0
            bar.skip(30)
            assert bar.line() == "analysis: 100% (30 of 30 steps), time left unknown yet"
        with Progress("fits", total=2, unit="fits") as bar:
            clock[0] = 5.0
            assert bar.line() == "fits: 0% (0 of 2 fits), time left unknown yet"
            clock[0] = 32.0
            bar.update(1)
            assert bar.line() == "fits: 50% (1 of 2 fits), 30 s left of the whole"


def test_lines_come_at_the_same_intervals_when_stages_are_shorter(capsys):
    begun = time.monotonic()
    with stages({"a": 1.0}, interval=0.3):
        while time.monotonic() - begun < 1.05:
            with Progress("a", total=2, unit="x"):
                time.sleep(0.02)
    assert 2 <= len(capsys.readouterr().err.splitlines()) <= 3


@pytest.mark.parametrize("show", [True, False])
def test_nothing_is_printed_before_the_interval_or_if_hidden(show, capsys):
    interval = 1e6 if show else 0.001
    with stages({"validation": 1.0}, interval=interval), Progress("validation", total=2, unit="x", show=show) as bar:
        bar.update()
        time.sleep(0.05)
    assert capsys.readouterr() == ("", "")


def test_durations_are_written_in_their_two_largest_units():
    assert [in_words(seconds) for seconds in (0.4, 59.6, 72.0, 3725.0)] == [
        "0 s",
        "1 min 0 s",
        "1 min 12 s",
        "1 h 2 min",
    ]
