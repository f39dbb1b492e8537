"""Tests of the console's history: each packet is kept once, peaks are kept, and past states are found."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from flight.link.telemetry.packets import LAYOUTS
from ground.console.commanding import CommandForms
from ground.console.history import History, PageCursor, PageState, values
from ground.console.server import Console
from ground.console.surroundings import UNKNOWN
from ground.telemetry import Run, read_run
from tests.ground.report.synthetic import Recipe, make_run

LATER = 10**15


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return read_run(make_run(tmp_path_factory.mktemp("run"), Recipe(duration=6.0, rate_hz=10.0, hold=3.0)))


@pytest.fixture
def history(run: Run) -> Iterator[History]:
    """Yield the history of a run, read in two updates."""
    with History() as history:
        for half in (0, 1):
            cut = {name: len(rows) // 2 for name, rows in run.flight.packets.items()}
            history.append(
                {n: rows[cut[n] :] if half else rows[: cut[n]] for n, rows in run.flight.packets.items()}
            )
        yield history


def test_all_packets_come_back_as_they_were(history: History, run: Run) -> None:
    for name, rows in run.flight.packets.items():
        assert history.rows(name, 0, 10**9).tobytes() == rows.tobytes()
    assert history.span_ns[1] == max(rows["time_ns"][-1] for rows in run.flight.packets.values() if len(rows))


def test_a_series_of_few_points_keeps_the_least_and_the_greatest(history: History, run: Run) -> None:
    rows = run["control"]
    times, whole = history.series("control", "current_written", 0, (0, LATER), 10**6)
    np.testing.assert_array_equal(whole, rows["current_written"][:, 0])
    few, thinned = history.series("control", "current_written", 0, (0, LATER), 10)
    assert len(thinned) == 10
    assert (thinned.min(), thinned.max()) == (whole.min(), whole.max())
    assert (np.diff(few) >= 0.0).all()
    assert set(few) <= set(times)
    part, _ = history.series("control", "q2", 0, (int(2e9), int(3e9)), 10**6)
    assert (part.min() >= 2.0, part.max() <= 3.0, len(part)) == (True, True, 11)


def test_a_peak_among_gaps_is_not_lost() -> None:
    layout = LAYOUTS["control"]
    rows = np.zeros(1000, dtype=layout.dtype)
    rows["time_ns"], rows["q2"] = np.arange(1000) * 10**7, np.nan
    rows["q2"][[333, 501]] = 7.0, -7.0
    with History() as history:
        history.append({"control": rows})
        _, values = history.series("control", "q2", 0, (0, LATER), 20)
    assert (np.nanmax(values), np.nanmin(values)) == (7.0, -7.0)


def test_an_instant_shows_what_had_come_and_each_event_once(history: History, run: Run) -> None:
    instant = PageState(history)
    seen = [instant.at(int(time * 1e9), LAYOUTS) for time in (0.0, 2.0, 4.0, 99.0)]
    assert [state["again"] for state in seen] == [True, False, False, False]
    events = [event for state in seen for event in state["listed"].get("event", [])]
    assert events == [values(row) for row in run["event"]]
    assert seen[1]["newest"]["control"]["time_ns"] <= 2 * 10**9
    assert "run" not in seen[1]["newest"], "nothing new"
    instant.reset()
    assert instant.at(LATER, LAYOUTS)["newest"]["control"] == values(run["control"][-1])


def test_packets_that_are_too_old_for_a_list_are_counted(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ground.console.history._MAX_LISTED", 2)
    rows = np.repeat(run["event"][:1], 7)
    with History() as history:
        history.append({"event": rows})
        page = PageState(history)
        state = page.at(LATER, LAYOUTS)
        assert (len(state["listed"]["event"]), state["omitted"]) == (2, {"event": 5})
        history.append({"event": rows[:1]})
        assert page.at(LATER, LAYOUTS)["omitted"] == {}


def test_a_replay_shows_at_each_time_what_was_live_then(history: History, run: Run) -> None:
    """The live state at a time equals the state that a replay shows for this time."""
    for until in (1_000_000_000, 3_300_000_000):
        with History() as then:
            then.append({n: rows[rows["time_ns"] <= until] for n, rows in run.flight.packets.items()})
            live = PageState(then).at(then.span_ns[1], LAYOUTS)
        assert PageState(history).at(until, LAYOUTS) == live


@pytest.mark.parametrize(
    "message",
    ["", "[]", "null", '{"at": NaN, "speed": 1}', '{"at": 1, "speed": -1}', '{"at": 1, "speed": 1e9}', "{}"],
)
def test_a_cursor_ignores_invalid_messages(message: str) -> None:
    cursor = PageCursor()
    assert not cursor.obey(message, 0.0)
    assert cursor.live


def test_a_cursor_moves_at_its_speed_stays_within_and_goes_live_again() -> None:
    cursor, span = PageCursor(), (0, 10 * 10**9)
    assert cursor.at_ns(span, 5.0) == span[1]
    assert cursor.obey('{"at": 2.0, "speed": 3.0}', 100.0)
    assert [cursor.at_ns(span, now) for now in (100.0, 101.0, 200.0)] == [2 * 10**9, 5 * 10**9, span[1]]
    assert cursor.obey('{"live": true}', 200.0)
    assert cursor.live


def test_packets_that_the_disk_refuses_are_stored_whole_later(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file on a full disk keeps the first bytes of a failed write."""
    packets = {name: rows for name, rows in run.flight.packets.items() if len(rows) > 1}
    halves = [{name: rows[part] for name, rows in packets.items()} for part in (slice(1), slice(1, None))]

    pwrite = os.pwrite

    def full(file: int, data: bytes, place: int) -> int:
        if file == stored._tracks[max(packets)]._file.fileno():
            pwrite(file, data[:7], place)
            raise OSError(errno.ENOSPC, "No space left on device")
        return pwrite(file, data, place)

    with History() as stored:
        stored.append(halves[0])
        feed = Mock(new=Mock(return_value=dict(run.flight.packets) | halves[1]), restarts=0)
        console = Console("run", feed, stored, UNKNOWN, CommandForms(None))
        with monkeypatch.context() as patch:
            patch.setattr(os, "pwrite", full)
            console.read()
            assert "No space left" in console.trouble
            assert {name: stored.count(name, LATER) for name in packets} == dict.fromkeys(packets, 1)
        console.read()
        assert (console.trouble, feed.new.call_count) == ("", 1)
        for name, rows in packets.items():
            assert stored.rows(name, 0, 10**9).tobytes() == rows.tobytes()


def test_the_history_leaves_no_file_that_another_program_could_remove(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Programs that tidy the temporary folder remove the files that were not used for some days."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with History() as history:
        history.append(run.flight.packets)
        assert list(tmp_path.iterdir()) == []
        assert history.rows("run", 0, 1).tobytes() == run.flight.packets["run"][:1].tobytes()
