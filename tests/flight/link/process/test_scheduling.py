"""Tests that scheduled commands run once at their UTC, even after a restart.

Late commands are reported and not run.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from flight.link.commands import (
    ChangeMode,
    CommandError,
    Ping,
    Point,
    Slew,
    command_of_words,
    unpack,
    words_of,
)
from flight.link.events import FOREIGN_MODES, Mode
from flight.link.files.store import line_of, overwrite, to_record
from flight.link.process import commanding, directives
from flight.link.process.commanding import (
    AT_MOST,
    LATEST_NS,
    MOST_ENTRIES,
    Report,
    Scheduling,
    Sent,
    Stage,
    Timetable,
    TimetableError,
)
from flight.link.process.directives import Deletion, Directive, Listing, Scheduled
from flight.link.process.station import REBUILT
from flight.link.security import new_key
from flight.link.telemetry.definitions import RUN
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from tests.flight.link.process.both_ends import BothEnds


@pytest.fixture
def link(tmp_path: Path) -> Iterator[BothEnds]:
    both = BothEnds(tmp_path)
    both.record(both.mode_packet(Mode.HOLD, "start"))
    yield both
    both.close()


def send(link: BothEnds, directive: Directive) -> int:
    counter = link.terminal.send(directives.pack(directive, link.clock.utc_ns()))
    link.turn()
    return counter


def in_seconds(link: BothEnds, seconds: float) -> str:
    utc = datetime.fromtimestamp(link.clock.utc_ns() * 1e-9, UTC) + timedelta(seconds=seconds)
    return f"{utc:%Y-%m-%dT%H:%M:%S}"


def texts(link: BothEnds, counter: int) -> list[str]:
    return [report.text for report in link.reports() if report.counter == counter]


def test_nothing_is_scheduled_while_the_folder_of_keys_may_be_mounted_later(link: BothEnds) -> None:
    """The folder that is mounted later contains its own schedule, which a new entry would overwrite."""
    link.sky.remove(1)
    link.sky.rebuilt = True
    scheduled = directives.pack(Scheduled(in_seconds(link, 9.0), "ping 1"), link.clock.utc_ns())
    refused = link.terminal.send(scheduled, spi=2)
    link.turn()
    assert texts(link, refused)[1:] == [REBUILT]
    assert not list(link.sky.folder.glob("schedule.*"))
    change = directives.pack(directives.NewKey(1, 2, new_key()), link.clock.utc_ns())
    link.terminal.send(change, spi=2)
    link.turn()
    accepted = link.terminal.send(scheduled, spi=2)
    link.turn()
    assert texts(link, accepted)[1:] != [REBUILT]
    assert link.stages(accepted, 2) == ["accepted", "completed"]


@pytest.mark.parametrize(
    ("at", "words", "problem"),
    [
        (
            "2262-04-12T00:00:00",
            "ping 1",
            "2262-04-12T00:00:00 is too late: give a time up to 2262-04-11T23:47:16Z",
        ),
        ("9999-12-31T23:59:59-14:00", "ping 1", "is too late"),
        ("2099-01-01T00:00:00", "ping 4294967296", "number = 4294967296 cannot be stored as u4"),
        ("2099-01-01T00:00:00", "ping -1", "number = -1 cannot be stored as u4"),
    ],
)
def test_a_number_that_a_file_or_a_packet_does_not_hold_is_refused_when_it_is_scheduled(
    link: BothEnds, at: str, words: str, problem: str
) -> None:
    kept = send(link, Scheduled(in_seconds(link, 60), "ping 7"))
    counter = send(link, Scheduled(at, words))
    assert link.stages(counter) == ["accepted", "failed"]
    assert problem in texts(link, counter)[-1]
    link.restart()
    link.turn(61.0)
    assert link.stages(kept)[-1] == "completed", "the schedule outlives the restart"


def test_an_entry_of_another_release_that_fits_no_packet_is_reported_and_not_executed(link: BothEnds) -> None:
    at_ns = link.clock.utc_ns() + 10**9
    Timetable(link.sky.folder).add(at_ns, 1, 77, "ping 99999999999")
    link.restart()
    link.turn(3.0)
    assert link.stages(77) == ["failed"]
    assert link.obeyed == []


def test_the_answer_and_the_list_show_angles_in_degrees(link: BothEnds) -> None:
    at = in_seconds(link, 60)
    counter = send(link, Scheduled(at, "point ground 52.5deg 13.4deg roll 90deg"))
    assert (
        texts(link, counter)[0]
        == f"at {at}: point ground latitude 52.5000, longitude 13.4000 deg, roll 90 deg"
    )
    assert (
        texts(link, send(link, Listing()))[1]
        == f"1: {at}Z point ground latitude 52.5000, longitude 13.4000 deg, roll 90 deg"
    )


def test_a_scheduled_command_outlives_a_restart_and_is_executed_once_at_its_time(link: BothEnds) -> None:
    late = send(link, Scheduled(in_seconds(link, 60), "ping 7"))
    soon = send(link, Scheduled(in_seconds(link, 20), "ping 3"))
    listing = send(link, Listing())
    assert [text[-6:] for text in texts(link, listing)[1:3]] == ["ping 3", "ping 7"]
    link.restart()
    link.turn(15.0)
    assert link.obeyed == []
    link.turn(5.0)
    assert [unpack(data) for data in link.obeyed] == [Ping(3)]
    assert link.stages(soon) == ["accepted", "completed", "started", "completed"], "kept, then executed"
    link.restart()
    link.turn(45.0)
    assert [unpack(data) for data in link.obeyed] == [Ping(3), Ping(7)]
    assert texts(link, late)[-1] == "ping 7"


def test_a_time_that_passes_during_a_stop_is_reported_and_not_executed(link: BothEnds) -> None:
    counter = send(link, Scheduled(in_seconds(link, 20), "slew 0.2"))
    link.clock.advance(40_000_000_000)
    link.restart()
    link.turn()
    assert link.obeyed == []
    assert link.stages(counter)[-1] == "failed"
    assert texts(link, counter)[-1].startswith("not executed, it is ")
    assert texts(link, counter)[-1].endswith("slew to q2 +0.2000")
    assert texts(link, send(link, Listing()))[-1] == "0 scheduled"


def test_more_commands_at_one_time_than_may_wait_for_answers_are_all_executed(link: BothEnds) -> None:
    at = in_seconds(link, 5)
    counters = [send(link, Scheduled(at, f"ping {number}")) for number in range(AT_MOST + 2)]
    link.turn(8.0)
    assert [unpack(data) for data in link.obeyed] == [Ping(number) for number in range(AT_MOST + 2)]
    assert all(link.stages(counter)[-1] == "completed" for counter in counters)


def test_safe_suspends_the_schedule(link: BothEnds) -> None:
    counter = send(link, Scheduled(in_seconds(link, 5), "mode hold"))
    link.record(link.mode_packet(Mode.SAFE, "commanded"))
    link.turn(8.0)
    assert link.obeyed == []
    assert "the flight is in mode SAFE" in texts(link, counter)[-1]


def test_the_list_has_the_results_of_past_entries(link: BothEnds) -> None:
    """A ground station that was not in contact at the time of a scheduled command receives its result."""
    at = in_seconds(link, 5)
    send(link, Scheduled(at, "ping 7"))
    send(link, Scheduled(at, "mode hold"))
    link.turn(8.0)
    link.record(link.mode_packet(Mode.SAFE, "commanded"))
    late = in_seconds(link, 5)
    send(link, Scheduled(late, "point sun"))
    link.turn(8.0)
    waiting = in_seconds(link, 900)
    send(link, Scheduled(waiting, "ping 9"))
    assert texts(link, send(link, Listing()))[1:] == [
        f"completed: past entry 1: {at}Z ping 7",
        f"completed: past entry 2: {at}Z mode hold",
        f"not executed, the flight is in mode SAFE: past entry 3: {late}Z point sun, roll free",
        f"4: {waiting}Z ping 9",
        "1 scheduled",
    ]
    for _ in range(9):
        send(link, Scheduled(in_seconds(link, 2), "ping 1"))
        link.turn(4.0)
    assert len(texts(link, send(link, Listing()))[1:-2]) == 8


def test_commands_that_cannot_be_scheduled_are_refused_with_the_reason(link: BothEnds) -> None:
    def refused(at: str, words: str) -> str:
        counter = send(link, Scheduled(at, words))
        assert link.stages(counter) == ["accepted", "failed"]
        return texts(link, counter)[-1]

    later = in_seconds(link, 3600)
    assert "has passed" in refused(in_seconds(link, -1), "ping 1")
    assert "is not a UTC" in refused("tomorrow", "ping 1")
    assert "is not a UTC" in refused("2099-01-01", "ping 1"), "the time of day is missing"
    assert "is not a command" in refused(later, "schedule x ping")
    assert "must lie within" in refused(later, "slew 3")
    assert "unexpected words after dump-parameters" in refused(later, "dump-parameters 1")
    assert "no command is scheduled with the number 5" in texts(link, send(link, Deletion(5)))[-1]
    for _ in range(MOST_ENTRIES):
        link.terminal.send(directives.pack(Scheduled(later, "ping 1"), 1))
    link.turn()
    assert "32 commands are scheduled already" in refused(later, "ping 1")
    send(link, Deletion(0))
    assert texts(link, send(link, Listing()))[-1] == "0 scheduled"
    with pytest.raises(CommandError, match="too long"):
        directives.pack(Scheduled(later, "safe " + "x" * 91), 1)


@pytest.mark.parametrize("writes", range(3))
def test_after_a_kill_at_any_write_no_entry_is_executed_twice(
    tmp_path: Path, writes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = Timetable(tmp_path)
    table.add(5, 1, 9, "ping 1")
    left = iter(range(writes))

    def until_killed(path: Path, data: bytes) -> bool:
        if next(left, None) is None:
            path.write_bytes(data[:10])  # a truncated file
            raise KeyboardInterrupt
        return overwrite(path, data)

    monkeypatch.setattr(commanding, "overwrite", until_killed)
    removed = False
    try:
        table.remove(1)
        removed = True
    except KeyboardInterrupt:
        pass
    again = Timetable(tmp_path)
    assert not again.lost
    assert not (removed and again.entries), "handed over, and again after the restart"
    assert len(again.entries) == (writes == 0)


def test_an_entry_whose_removal_reached_one_copy_is_not_there_after_a_failed_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first write reports a failure but reaches the disk; the next write reaches only the second copy."""
    table = Timetable(tmp_path)
    table.add(5, 1, 9, "ping 1")
    monkeypatch.setattr(commanding, "overwrite", lambda path, data: overwrite(path, data) and False)
    with pytest.raises(TimetableError):
        table.add(6, 1, 10, "ping 2")
    monkeypatch.setattr(
        commanding, "overwrite", lambda path, data: path.name.endswith("b") and overwrite(path, data)
    )
    table.remove(1)
    assert Timetable(tmp_path).entries == ()


def test_fields_that_a_later_release_has_added_to_the_schedule_are_ignored(tmp_path: Path) -> None:
    """After a return to an earlier release, the commands that were scheduled before are executed."""
    table = Timetable(tmp_path)
    entry = table.add(5, 1, 9, "ping 1")
    for path in tmp_path.glob("schedule.*"):
        values = json.loads(line_of(path.read_bytes()) or b"")
        for part in (values, *values["entries"]):
            part["added"] = 1
        path.write_bytes(to_record(json.dumps(values).encode()))
    again = Timetable(tmp_path)
    assert (again.lost, again.entries) == (False, (entry,))


def test_a_lost_schedule_is_reported_and_a_full_disk_refuses(
    link: BothEnds, monkeypatch: pytest.MonkeyPatch
) -> None:
    send(link, Scheduled(in_seconds(link, 60), "ping 7"))
    for path in link.sky.folder.glob("schedule.*"):
        path.write_bytes(b"x")
    link.restart()
    link.turn()
    assert (
        link.reports()[-1].text
        == "both copies of the schedule are lost or outdated, so the schedule is empty"
    )
    monkeypatch.setattr(commanding, "overwrite", lambda *_: False)
    with pytest.raises(TimetableError, match="could not be stored"):
        Timetable(link.sky.folder).add(5, 1, 9, "ping 1")


def test_a_due_command_that_cannot_be_removed_from_the_disk_is_reported_once_and_not_executed(
    link: BothEnds, monkeypatch: pytest.MonkeyPatch
) -> None:
    due = send(link, Scheduled(in_seconds(link, 2), "ping 7"))
    later = send(link, Scheduled(in_seconds(link, 600), "ping 8"))
    monkeypatch.setattr(commanding, "overwrite", lambda *_: False)
    link.turn(5.0)
    assert link.obeyed == []
    assert link.stages(due) == ["accepted", "completed", "failed"], "reported once"
    assert texts(link, due)[-1].startswith("not executed, the schedule could not be stored: 1: ")
    assert link.stages(later) == ["accepted", "completed"]
    monkeypatch.undo()
    assert texts(link, send(link, Listing()))[-1] == "1 scheduled"


@pytest.mark.parametrize(
    ("body", "accepted", "refused"),
    [
        ("orbit", ("point sun", "mode detumble", "safe", "ping 1"), ("slew 0.2", "mode hold")),
        ("testbed", ("slew 0.2", "mode hold", "safe"), ("point sun", "mode sun", "mode point")),
        ("own", ("slew 0.2", "point sun", "mode hold"), ()),
    ],
)
def test_a_command_to_a_mode_that_the_body_does_not_have_is_not_scheduled(
    tmp_path: Path, body: str, accepted: tuple[str, ...], refused: tuple[str, ...]
) -> None:
    scheduling = Scheduling(Timetable(tmp_path), FOREIGN_MODES.get(body, frozenset()))
    done = Report(1, 12, Stage.COMPLETED, "schedule", "")
    for words in (*accepted, *refused):
        (answer,) = scheduling.obey(Scheduled("2099-01-01T00:00:00", words), done, 0)
        assert answer.stage is (Stage.COMPLETED if words in accepted else Stage.FAILED)
        assert words in accepted or "this body has no mode " in answer.text


def _scheduling(tmp_path: Path, mode: Mode | None = Mode.HOLD) -> tuple[Scheduling, int]:
    """Return a scheduler with one command, and the due time (ns) of this command."""
    table, at_ns = Timetable(tmp_path), 1_800_000_000 * 10**9
    table.add(at_ns, 1, 9, "ping 3")
    made = Scheduling(table)
    made._mode = None if mode is None else int(mode)
    return made, at_ns


@pytest.mark.parametrize(
    ("mode", "delay_ns", "outcome"),
    [
        (Mode.HOLD, -1, "waits"),
        (Mode.HOLD, 0, "sent"),
        (Mode.HOLD, LATEST_NS, "sent"),
        (Mode.HOLD, LATEST_NS + 1, "late"),
        (None, LATEST_NS, "waits"),
        (None, LATEST_NS + 1, "late"),
        (Mode.SAFE, LATEST_NS, "safe"),
    ],
)
def test_a_command_is_due_from_its_time_on_for_ten_seconds(
    mode: Mode | None, delay_ns: int, outcome: str, tmp_path: Path
) -> None:
    scheduling, at_ns = _scheduling(tmp_path, mode)
    found = list(scheduling.due(at_ns + delay_ns))
    assert len(Timetable(tmp_path).entries) == (outcome == "waits")
    if outcome == "waits":
        assert found == []
        return
    (one,) = found
    assert (one.spi, one.counter) == (1, 9)
    if outcome == "sent":
        assert isinstance(one, Sent)
        assert one.command == Ping(3)
        return
    assert isinstance(one, Report)
    assert one.stage is Stage.FAILED
    assert {"late": "not executed, it is", "safe": "the flight is in mode SAFE"}[outcome] in one.text


@pytest.mark.parametrize(("early_ns", "scheduled"), [(1, True), (0, False), (-1, False)])
def test_only_a_future_time_can_be_scheduled(early_ns: int, scheduled: bool, tmp_path: Path) -> None:
    scheduling, at_ns = _scheduling(tmp_path)
    at = f"{datetime.fromtimestamp(at_ns * 1e-9, UTC):%Y-%m-%dT%H:%M:%S}"
    done = Report(1, 12, Stage.COMPLETED, "schedule", "")
    (answer,) = scheduling.obey(Scheduled(at, "ping 4"), done, at_ns - early_ns)
    assert answer.stage is (Stage.COMPLETED if scheduled else Stage.FAILED)
    assert answer.text.startswith("2: " if scheduled else f"{at} has passed: it is ")
    assert len(Timetable(tmp_path).entries) == 1 + scheduled


def test_words_are_read_by_the_table() -> None:
    assert command_of_words("slew -0.2") == Slew(-0.2)
    assert command_of_words("safe end of pass") == ChangeMode(Mode.SAFE, "end of pass")
    assert command_of_words("mode hold") == ChangeMode(Mode.HOLD)
    assert command_of_words("point sun") == Point(PointingTarget(Goal.SUN, (), None))
    for wrong in ("", "mode up", "ping", "ping x", "slew 0.1 0.2", "point sun roll", "dump-parameters 1"):
        with pytest.raises(CommandError):
            command_of_words(wrong)


@pytest.mark.parametrize(
    "words", ["point nadir 90deg", "point sun 5deg roll 3deg", "point ground 1deg 2deg 3deg"]
)
def test_a_number_that_the_goal_does_not_take_is_refused_and_not_ignored(words: str) -> None:
    """For example, `point nadir 90deg` gives a roll angle without the word `roll`."""
    with pytest.raises(CommandError, match="takes at most"):
        command_of_words(words)


def test_angles_in_words_have_their_unit() -> None:
    target = PointingTarget(Goal.GROUND, (math.radians(52.5), math.radians(-13.4)), math.radians(90.0))
    for words in ("point ground 52.5deg -13.4deg roll 90deg", "point ground 52.5deg -13.4deg --roll 90deg"):
        assert command_of_words(words) == Point(target)
    assert words_of(Point(target)) == "point ground 52.5deg -13.4deg roll 90deg"
    for wrong in (
        "point ground 0.91 0.23",
        "point nadir roll 90",
        "point inertial 0 0 0 1 0.5",
        "point sun roll xdeg",
    ):
        with pytest.raises(CommandError, match="deg"):
            command_of_words(wrong)


def test_a_line_that_an_earlier_release_stored_has_angles_in_rad() -> None:
    assert command_of_words("point ground 0.5 0.2 nan nan 1.5", stored=True) == Point(
        PointingTarget(Goal.GROUND, (0.5, 0.2), 1.5)
    )


def label(link: BothEnds, utc_ns: int) -> bytes:
    """Return the first packet of a run, in which the present mission time corresponds to the UTC `utc_ns`."""
    fields: dict[str, Any] = {field.name: [0.0] * 3 if field.count == 3 else 0 for field in RUN.fields}
    fields |= {"config_name": "orbit", "software": "1", "utc_ns": utc_ns - link.clock.now_ns()}
    return link.packer.pack(RUN, link.clock.now_ns(), fields)


def fly(link: BothEnds, seconds: int) -> None:
    """Write one packet per second into the flight log."""
    for _ in range(seconds):
        link.record(link.mode_packet(Mode.HOLD, "again"))
        link.turn(1.0)


@pytest.mark.parametrize("days", [2500, 40])
def test_the_schedule_follows_the_utc_of_the_flight(link: BothEnds, days: int) -> None:
    """Scheduled commands run at the UTC of the flight, which may differ from the wall clock."""
    begun_ns = link.clock.utc_ns()
    link.record(label(link, begun_ns))
    link.turn(2.0)
    simulated = timedelta(days=days)
    link.record(label(link, link.clock.utc_ns() + round(simulated.total_seconds()) * 10**9))
    fly(link, 3)
    now = datetime.fromtimestamp(link.clock.utc_ns() * 1e-9, UTC) + simulated
    early = send(link, Scheduled(f"{now - timedelta(seconds=20):%Y-%m-%dT%H:%M:%S}", "ping 1"))
    assert f"it is {now:%Y-%m-%dT%H:%M}" in texts(link, early)[-1]
    send(link, Scheduled(f"{now + timedelta(seconds=10):%Y-%m-%dT%H:%M:%S}", "ping 5"))
    later = send(link, Scheduled(f"{now + timedelta(seconds=30):%Y-%m-%dT%H:%M:%S}", "ping 6"))
    fly(link, 14)
    assert [unpack(data) for data in link.obeyed] == [Ping(5)]
    link.restart()
    link.turn(5.0)
    assert "not executed" not in " ".join(texts(link, later)), "the UTC of the flight is not known yet"
    link.record(label(link, link.clock.utc_ns() + round(simulated.total_seconds()) * 10**9))
    fly(link, 16)
    assert [unpack(data) for data in link.obeyed] == [Ping(5), Ping(6)], texts(link, later)
