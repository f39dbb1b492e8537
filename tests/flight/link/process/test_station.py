"""Tests that the link process passes commands once with verification, and sends live and old telemetry."""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flight.link.commands import ChangeMode, Command, CommandError, CommandPacker, Ping, Slew, unpack
from flight.link.events import Mode
from flight.link.frames import idle_packet
from flight.link.process import directives, downlink, station
from flight.link.process.commanding import Sent, Stage, Verification
from flight.link.process.directives import Deletion, NewKey, Play, Portion, Stop
from flight.link.process.downlink import LIVE, PLAYBACK, Downlink
from flight.link.security import WINDOW, Admitted
from flight.link.telemetry.definitions import (
    COMMAND,
    CYCLE_TIMING,
    EVENT,
    FIX,
    HEALTH,
    MODE,
    RUN,
    Field,
    Packet,
)
from flight.link.telemetry.log import SegmentStore
from flight.link.telemetry.packets import CRC_BYTES, LAYOUTS, Packer, compile_layouts, crc16
from flight.schema.sections import LinkCoding
from ground.link.terminal import TerminalSettings
from hal.interfaces.wires import SECOND_NS
from knightcube.errors import KnightCubeError
from tests.flight.link.process.both_ends import BothEnds, Wire
from tests.flight.link.telemetry.samples import plain_contents, timing_packets
from tests.flight.link.vaults import frame_with


@pytest.fixture
def link(tmp_path: Path) -> Iterator[BothEnds]:
    both = BothEnds(tmp_path)
    yield both
    both.close()


def packet(command: Command, time_ns: int = 1) -> bytes:
    return CommandPacker().pack(command, time_ns)


def test_a_command_is_handed_over_and_verified_stage_by_stage(link: BothEnds) -> None:
    counter = link.terminal.send(packet(Ping(7)))
    link.turn()
    assert [unpack(data) for data in link.obeyed] == [Ping(7)]
    assert link.stages(counter) == ["accepted", "started", "completed"]
    assert link.status()["highest"].tolist() == [counter, -1]


def test_a_slew_is_completed_when_it_arrives_and_fails_otherwise(link: BothEnds) -> None:
    link.mode = Mode.SLEW
    first = link.terminal.send(packet(Slew(0.1)))
    link.turn()
    assert link.stages(first) == ["accepted", "started"]
    second = link.terminal.send(packet(Slew(0.2)))
    link.turn()
    assert link.stages(first)[-1] == "failed"
    link.record(link.mode_packet(Mode.HOLD, "arrived"))
    link.turn()
    assert link.stages(second) == ["accepted", "started", "completed"]
    third = link.terminal.send(packet(Slew(0.3)))
    link.turn()
    link.record(link.mode_packet(Mode.HOLD, "reaction hold"))
    link.turn()
    assert link.stages(third) == ["accepted", "started", "failed"]


def test_a_command_that_a_restart_of_the_flight_interrupts_fails(link: BothEnds) -> None:
    """The mission time of the next flight begins at zero again."""
    link.turn(30.0)
    counter = link.terminal.send(packet(Slew(0.2)))
    link.turn()
    assert link.stages(counter)[-1] == "started"
    begun = {"before": 0, "mode": int(Mode.BOOT), "trigger": "begin", "reason": "", "target_q2": 0.0}
    link.record(link.packer.pack(MODE, 0, begun))
    link.turn()
    assert link.stages(counter)[-1] == "failed"


def test_a_late_packet_of_the_begin_of_a_flight_does_not_end_a_command(link: BothEnds) -> None:
    begun = {"before": 0, "mode": int(Mode.BOOT), "trigger": "begin", "reason": "", "target_q2": 0.0}
    counter = link.terminal.send(packet(Slew(0.2)))
    link.turn()
    link.record(link.packer.pack(MODE, 0, begun))
    link.turn()
    assert link.stages(counter)[-1] == "started"


def test_each_way_to_refuse_has_its_report_and_its_count(link: BothEnds) -> None:
    no_command = link.terminal.send(b"no packet")
    refused = link.terminal.send(packet(ChangeMode(Mode.HOLD)))
    link.turn(answer=lambda _: False)
    assert link.stages(no_command) == ["refused"]
    assert link.stages(refused) == ["accepted", "failed"]
    link.flight.close()
    nobody = link.terminal.send(packet(Ping(1)))
    link.turn(1.1)
    assert link.stages(nobody) == ["accepted", "failed"]
    assert link.status()["refused_command"] == 3
    assert link.status()["admitted"] == 3


def test_a_flight_that_does_not_answer_is_reported_after_five_seconds(link: BothEnds) -> None:
    counter = link.terminal.send(packet(Ping(1)))
    link.station.turn()
    link.flight.close()
    link.turn(4.5)
    assert link.stages(counter) == ["accepted"]
    link.turn(1.0)
    assert link.stages(counter) == ["accepted", "failed"]


def test_refusals_and_the_highest_counter_are_in_the_first_packet(link: BothEnds) -> None:
    frame_of = link.terminal.send(packet(Ping(1)))
    frame = link.wire.up[0]
    link.turn()
    link.restart()
    link.packets.clear()
    link.wire.up += [frame, frame[:-1] + bytes([frame[-1] ^ 1])]
    link.turn(1.1)
    assert link.packets[0][1][:2] == LAYOUTS["link"].identifier.to_bytes(2, "big")
    (first,) = LAYOUTS["link"].array(link.packets[0][1])
    assert first["highest"].tolist() == [frame_of, -1]
    assert len(link.obeyed) == 1, "the restarted link has obeyed the old frame again"
    assert link.status()[["refused_repeated", "refused_crc"]].tolist() == (1, 1)
    assert link.stages(frame_of)[-1] == "repeated"


def test_a_repeated_frame_does_not_change_what_the_ground_knows_of_its_command(link: BothEnds) -> None:
    counter = link.terminal.send(packet(Slew(0.1)))
    frame = link.wire.up[0]
    link.turn()
    link.wire.up.append(frame)
    link.turn()
    link.record(link.mode_packet(Mode.HOLD, "arrived"))
    link.turn()
    assert link.stages(counter) == ["accepted", "started", "repeated", "completed"]


def test_a_ground_with_an_older_copy_of_its_keys_continues_above_the_highest_counter(link: BothEnds) -> None:
    backup = {path: path.read_bytes() for path in link.ground.folder.glob("spi-1.*")}
    for _ in range(3):
        link.terminal.send(packet(Ping(1)))
    link.turn()
    for path, data in backup.items():
        path.write_bytes(data)
    stale = link.terminal.send(packet(Ping(2)))
    link.turn(1.1)
    assert link.stages(stale)[-1] == "repeated"
    assert len(link.obeyed) == 3
    link.terminal.send(packet(Ping(3)))
    link.turn()
    assert unpack(link.obeyed[-1]) == Ping(3)


def test_the_ground_receives_which_counters_the_satellite_has_lost(link: BothEnds) -> None:
    link.turn(1.1)
    assert not link.terminal.lost_spis
    for path in link.sky.folder.glob("spi-1.*"):
        path.unlink()
    link.restart()
    link.terminal.send(packet(Ping(1)), spi=2)
    link.turn(1.1)
    assert link.terminal.lost_spis == (1,)


COUNTERS = [0, 2**31, 2**32, WINDOW, 2**63 - 1, 2**63, 2**64 - 1]
SALT = 0x9ABCDEF0 << 64


@pytest.mark.parametrize("counter", COUNTERS)
def test_an_authentic_frame_with_any_counter_is_refused_or_obeyed_and_the_link_goes_on(
    link: BothEnds, counter: int
) -> None:
    link.wire.up.append(frame_with(link.ground, SALT | counter, packet(Ping(3))))
    link.turn(1.1)
    shown, good = min(counter, 2**63 - 1), counter < WINDOW
    assert link.stages(shown) == (["accepted", "started", "completed"] if good else ["refused"])
    counts = link.status()[["admitted", "refused_beyond", "unreported"]]
    assert counts.tolist() == (good, not good, 0)
    link.wire.up.append(frame_with(link.ground, counter * good + 1, packet(Ping(4))))
    link.turn()
    assert unpack(link.obeyed[-1]) == Ping(4)


@pytest.mark.parametrize("counter", COUNTERS)
def test_a_counter_that_is_next_is_obeyed_up_to_the_highest(link: BothEnds, counter: int) -> None:
    entry = link.sky.read(1)
    assert entry is not None
    link.sky.write(replace(entry, unused=min(counter, 2**63)))
    link.restart()
    for salt in (0, SALT):
        link.wire.up.append(frame_with(link.ground, salt | counter, packet(Ping(3))))
    link.turn(1.1)
    good = counter < 2**63
    assert len(link.obeyed) == good
    assert link.status()["highest"][0] == min(counter, 2**63 - 1)
    assert link.status()[["admitted", "refused_repeated"]].tolist() == (good, good)
    stages = link.stages(min(counter, 2**63 - 1))
    assert [stages.count("repeated"), stages.count("refused")] == [good, 2 * (not good)]


def test_a_report_that_cannot_be_packed_is_counted_and_reported_and_does_not_end_the_link(
    link: BothEnds, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(station, "_HIGHEST_REPORTED", 2**64)
    said: list[str] = []
    for _ in range(3):
        link.wire.up.append(frame_with(link.ground, 2**64 - 1, packet(Ping(3))))
    turns = iter([False] * 60)
    link.station.run(lambda: next(turns, True), said.append, lambda: None)
    link.collect()
    assert link.status()[["refused_beyond", "unreported"]].tolist() == (3, 3)
    assert [text.partition(" could")[0] for text in said] == ["3 reports"]
    assert "counter = 18446744073709551615 cannot be stored as i8" in said[0]


def test_reports_that_newer_ones_displace_are_counted(tmp_path: Path) -> None:
    with closing(BothEnds(tmp_path, rate=100.0)) as link:
        for _ in range(300):
            link.terminal.send(b"no packet")
        link.station.turn()
        assert link.station.unreported == 300 + 1 - 256, "a refusal each, and the first state of the link"


def test_a_log_that_states_any_time_does_not_end_the_link(link: BothEnds) -> None:
    link.record(link.packer.pack(CYCLE_TIMING, 2**63 - 1, plain_contents(CYCLE_TIMING)))
    link.turn(2.0)
    counter = link.terminal.send(packet(Ping(1)))
    link.turn()
    assert link.stages(counter) == ["accepted", "started", "completed"]
    assert link.status()["time_ns"] == 2**63 - 1


@pytest.mark.parametrize("kind", [RUN, MODE, HEALTH, EVENT, FIX, COMMAND], ids=lambda kind: kind.name)
@pytest.mark.parametrize("change", ["shorter", "longer"])
def test_packets_of_another_release_are_sent_down_and_do_not_end_the_link(
    link: BothEnds, kind: Packet, change: str
) -> None:
    """During a renewal, and after its end, flight and link may run different releases."""
    fields = kind.fields[:-1] if change == "shorter" else (*kind.fields, Field("more", "u1", "-", "more"))
    other = replace(kind, fields=fields, version=kind.version + 1)
    packer, values = Packer(compile_layouts([other])), plain_contents(other)
    for second in range(2):
        link.record(packer.pack(other, second * SECOND_NS, values))
        link.turn(1.0)
    assert len(link.of(kind.name)) >= 2
    counter = link.terminal.send(packet(Ping(1)))
    link.turn()
    assert link.stages(counter) == ["accepted", "started", "completed"]
    (answered,) = Verification().answered(Sent(1, counter, Ping(1)), packer.pack(other, 0, values))
    assert (answered.stage, answered.text) == (Stage.FAILED, "the flight answered in another version")


def test_the_loop_reports_progress_once_a_second_also_while_it_processes_many_frames(
    link: BothEnds, monkeypatch: pytest.MonkeyPatch
) -> None:
    beats: list[int] = []
    turns = iter([False] * 200)
    link.station.run(lambda: next(turns, True), str, lambda: beats.append(link.clock.now_ns()))
    assert len(beats) == 4
    slow = link.station._gate.admit

    def admit(frame: bytes) -> Admitted:
        link.clock.advance(500_000_000)  # emulates a disk that is slow to store a counter
        return slow(frame)

    monkeypatch.setattr(link.station._gate, "admit", admit)
    for _ in range(10):
        link.terminal.send(b"no packet")
    beats.clear()
    link.station.turn()
    assert len(beats) == 5


@pytest.mark.parametrize("number", [errno.EROFS, errno.ENOSPC, errno.EIO, errno.EACCES])
def test_a_disk_that_stores_no_counter_prevents_commands_and_does_not_end_the_link(
    link: BothEnds, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = link.terminal.send(packet(Ping(1)))
    link.turn()
    frame = frame_with(link.ground, first + 1, packet(Ping(2)))
    plain = os.open

    def fail(path: str | Path, flags: int, mode: int = 0o777) -> int:
        if flags & (os.O_WRONLY | os.O_RDWR) and Path(path).is_relative_to(link.sky.folder):
            raise OSError(number, os.strerror(number), str(path))
        return plain(path, flags, mode)

    with monkeypatch.context() as broken:
        broken.setattr(os, "open", fail)
        link.wire.up.append(frame)
        link.turn(1.1)
        assert link.stages(first + 1) == ["refused"]
        assert link.status()["refused_unstored"] == 1
        assert len(link.obeyed) == 1
    link.wire.up.append(frame)
    link.turn()
    assert [unpack(data) for data in link.obeyed] == [Ping(1), Ping(2)]


def test_an_archive_that_cannot_be_listed_for_a_while_ends_nothing(
    link: BothEnds, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as broken:
        broken.setattr(Path, "glob", fail)
        play = link.terminal.send(directives.pack(Play(3, 0.0, 1.0), 1))
        link.turn(2.0)
        assert link.stages(play) == ["accepted", "failed"]
    link.record(*timing_packets(3))
    link.turn(1.0)
    assert link.of("cycle_timing") == timing_packets(3)


@pytest.mark.parametrize(("count", "segments"), [(200, 1), (2000, 2)])
def test_a_log_that_was_removed_and_begun_again_is_followed(
    link: BothEnds, count: int, segments: int
) -> None:
    """The new log of the same run begins with the first segment again."""
    folder = link.place / "runs" / "run-000001"
    link.record(*timing_packets(count))
    link.turn(4.0)
    removed = list(folder.glob("flight-*"))
    assert len(removed) == segments
    link.log.close()
    for path in removed:
        path.unlink()
    link.turn(1.0)
    link.log, before = SegmentStore(folder, "flight", 1 << 16, 1 << 24), len(link.of("cycle_timing"))
    link.record(*timing_packets(5))
    link.turn(2.0)
    assert link.of("cycle_timing")[before:] == timing_packets(5)


def test_a_failed_access_to_the_log_does_not_send_the_log_again(
    link: BothEnds, monkeypatch: pytest.MonkeyPatch
) -> None:
    link.record(*timing_packets(200))
    link.turn(4.0)
    before, stat = len(link.of("cycle_timing")), Path.stat

    def fail(path: Path, **options: bool) -> os.stat_result:
        if path.name.startswith("flight-"):
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return stat(path, **options)

    with monkeypatch.context() as broken:
        broken.setattr(Path, "stat", fail)
        link.turn(2.0)
    link.turn(2.0)
    assert before > 0
    assert len(link.of("cycle_timing")) == before


def test_live_packets_come_in_order_and_none_is_lost(link: BothEnds) -> None:
    sent = timing_packets(300)
    for begin in range(0, 300, 30):
        link.record(*sent[begin : begin + 30])
        link.turn(0.1)
    link.turn()
    assert link.of("cycle_timing") == sent
    assert link.terminal.lost_frames == 0


def test_a_slow_line_thins_periodic_packets_and_loses_no_event(tmp_path: Path) -> None:
    link = BothEnds(tmp_path, rate=2000.0)
    events = [link.packer.pack(EVENT, n, plain_contents(EVENT)) for n in range(10)]
    for one in events:
        link.record(*timing_packets(200), one)
        link.turn(1.0)
    link.turn(6.0)
    assert link.of("event") == events
    assert 0 < len(link.of("cycle_timing")) < 1000
    assert link.status()["thinned"] > 500
    assert sum(map(len, (frame for frame in link.wire.down))) == 0
    link.close()


def test_an_interval_of_the_archive_is_played_back_completely_beside_live_telemetry(link: BothEnds) -> None:
    old = timing_packets(4000)  # enough packets for several segments of the log
    link.record(*old)
    link.turn(4.0)
    link.packets.clear()
    play = link.terminal.send(directives.pack(Play(0, 10.0, 60.0), 1))
    live = link.packer.pack(CYCLE_TIMING, 10**12, plain_contents(CYCLE_TIMING))
    link.record(live)
    link.turn(3.0)
    wanted = [one for n, one in enumerate(old) if 10.0 <= 0.025 * n <= 60.0]
    assert [one for channel, one in link.packets if channel == PLAYBACK] == wanted
    assert live in [one for channel, one in link.packets if channel == LIVE]
    assert link.stages(play) == ["accepted", "started", "completed"]
    missing = link.terminal.send(directives.pack(Play(9, 0.0, 1.0), 1))
    stop = link.terminal.send(directives.pack(Stop(), 1))
    link.turn()
    assert (link.stages(missing)[-1], link.stages(stop)[-1]) == ("failed", "completed")
    assert link.obeyed == [], "a command of the link went to the flight"


@pytest.mark.parametrize(("takes", "listened"), [(0, True), (1, True), (0, False)])
def test_a_playback_waits_for_a_line_that_takes_no_frames(tmp_path: Path, takes: int, listened: bool) -> None:
    link = BothEnds(tmp_path, rate=5e4)
    old = timing_packets(4000)
    link.record(*old)
    link.turn(10.0)
    link.packets.clear()
    play = link.terminal.send(directives.pack(Play(0, 0.0, 1e3), 1))
    link.turn(0.1)
    link.wire.takes, link.wire.listened = takes, listened
    link.turn(5.0)
    assert link.station._downlink.playing
    link.wire.takes, link.wire.listened = None, True
    link.turn(10.0)
    assert [one for channel, one in link.packets if channel == PLAYBACK] == old
    assert link.stages(play) == ["accepted", "started", "completed"]
    assert not (listened and link.terminal.lost_frames), "live telemetry is discarded while nobody listens"
    assert (link.status()["untaken"] > 0) == listened
    link.close()


def test_a_line_that_takes_nothing_is_reported_once_and_loses_no_report(link: BothEnds) -> None:
    said, turns = list[str](), iter([False] * 30_000)
    link.turn(1.0)
    link.wire.takes = 0
    counters = [link.terminal.send(packet(Ping(n))) for n in range(3)]
    link.station.run(lambda: next(turns, True), said.append, lambda: None)
    assert said == ["no telemetry can be sent on wire"]
    link.wire.takes = None
    link.station.turn()
    link.station.turn()
    link.collect()
    assert all("accepted" in link.stages(counter) for counter in counters)
    assert link.station.unreported == 0


def test_no_report_on_the_first_commands_of_a_contact_is_lost(link: BothEnds) -> None:
    """The line accepted no more frames at the end of the last contact, so frames of that time are left."""
    link.turn(1.0)
    link.wire.takes = 0
    link.record(*timing_packets(100))
    link.turn(0.5)
    link.wire.takes, link.wire.listened = None, False
    link.turn(60.0)
    link.wire.listened = True
    counters = [link.terminal.send(packet(Ping(n))) for n in range(8)]
    link.turn(1.0)
    assert all("accepted" in link.stages(counter) for counter in counters)


def test_a_line_that_is_slow_is_not_reported_and_carries_the_status_once_a_second(tmp_path: Path) -> None:
    """A radio of 960 bytes/s needs 1.3 s for a coded frame of 1115 bytes."""
    coding, said, turns = LinkCoding(reed_solomon=5), list[str](), iter([False] * 5_000)
    settings = TerminalSettings(frame_bytes=1115, coding=coding)
    link = BothEnds(tmp_path, 960.0, settings, codes=settings.codes())
    output, written = station._Output(), 0
    board, begun_ns = link.codes.on_board(), link.clock.now_ns()

    def write(data: bytes) -> int:
        nonlocal written
        room = 960 * (link.clock.now_ns() - begun_ns) // SECOND_NS - written
        link.wire.down.append(data[:room])
        written += min(room, len(data))
        return min(room, len(data))

    def send(frames: Sequence[bytes], now_ns: int) -> int:
        return output.send(list(map(board.wrap, frames)), write)

    link.wire.send = send  # type: ignore[method-assign]
    link.station.run(lambda: next(turns, True), said.append, lambda: None)
    link.collect()
    assert said == []
    assert link.station._transmitter.untaken > 100
    assert len(link.of("link")) > 90
    link.close()


def test_only_lines_that_take_nothing_are_reported_beside_a_line_that_works(link: BothEnds) -> None:
    lost, unused, turns, said = Wire(), Wire(), iter([False] * 5_000), list[str]()
    lost.name, lost.takes, unused.name, unused.listened = "lost", 0, "unused", False
    sent = timing_packets(300)
    lines = link.station._lines
    assert isinstance(lines, list)
    lines += [lost, unused]
    link.turn(1.0)
    link.record(*sent)
    counter = link.terminal.send(packet(Ping(1)))
    link.turn(1.0)
    assert link.stages(counter) == ["accepted", "started", "completed"]
    assert link.of("cycle_timing") == sent
    link.station.run(lambda: next(turns, True), said.append, lambda: None)
    link.collect()
    assert said == ["no telemetry can be sent on lost"]
    assert len(link.of("link")) > 90


@pytest.mark.parametrize("failures", [1, 3, 10**9])
def test_a_playback_repeats_failed_reads_and_reports_what_it_could_not_read(
    link: BothEnds, monkeypatch: pytest.MonkeyPatch, failures: int
) -> None:
    old = timing_packets(4000)
    link.record(*old)
    link.turn(4.0)
    link.packets.clear()
    left = failures

    def fail(path: Path, mode: str, **options: Any) -> Any:
        nonlocal left
        if path.name == "flight-0002.ccsds" and left:
            left -= 1
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return open(path, mode, **options)

    monkeypatch.setattr(downlink, "open", fail, raising=False)
    play = link.terminal.send(directives.pack(Play(0, 0.0, 1e3), 1))
    link.turn(60.0)
    played = [one for channel, one in link.packets if channel == PLAYBACK]
    if failures < 10:
        assert link.stages(play) == ["accepted", "started", "completed"]
        assert played == old
        return
    assert link.stages(play) == ["accepted", "started", "failed"]
    text = "unreadable parts: 1, first flight-0002.ccsds from byte 0: Input/output error"
    assert link.reports()[-1].text == text
    assert failures - left < 30, "each attempt is followed by a pause"
    assert 1000 < len(played) < len(old)
    assert (played[0], played[-1]) == (old[0], old[-1])


def test_after_a_key_change_frames_with_the_old_key_are_refused(link: BothEnds) -> None:
    key = bytes(range(32))
    change = link.terminal.send(directives.pack(NewKey(1, 2, key), 1))
    stale = link.terminal.send(directives.pack(NewKey(2, 7, key), 1))
    link.turn()
    assert link.stages(change) == ["accepted", "completed"]
    assert link.stages(stale) == []  # the command was protected with the old key
    assert link.status()["refused_mac"] == 1
    late = link.terminal.send(directives.pack(NewKey(2, 7, key), 1), spi=2)
    link.turn()
    assert link.stages(late, spi=2) == ["accepted", "failed"]
    assert link.status()["generation"].tolist() == [2, 1, 1, 1]


def test_a_key_is_not_set_again(link: BothEnds) -> None:
    """With the counter at 0, recorded commands with this key would be executed again."""
    present = link.sky.read(1)
    assert present is not None
    counter = link.terminal.send(directives.pack(NewKey(1, 2, present.key), 1))
    link.turn()
    assert link.stages(counter) == ["accepted", "failed"]
    assert link.status()["generation"].tolist() == [1, 1, 1, 1]


def test_a_stolen_primary_key_cannot_change_the_keys_of_the_reserves(link: BothEnds) -> None:
    key = bytes(range(32))
    for changed in (2, 4):
        counter = link.terminal.send(directives.pack(NewKey(changed, 2, key), 1))
        link.turn()
        assert link.stages(counter) == ["accepted", "failed"]
    assert link.status()["generation"].tolist() == [1, 1, 1, 1]
    for changed in (4, 1, 2):
        counter = link.terminal.send(directives.pack(NewKey(changed, 2, key), 1), spi=2)
        link.turn()
        assert link.stages(counter, spi=2) == ["accepted", "completed"]
    assert link.status()["generation"].tolist() == [2, 2, 1, 2]


def test_a_stolen_primary_key_cannot_begin_a_packet_that_the_reserve_key_ends(link: BothEnds) -> None:
    """The attacker sends a whole packet as the first portion; the operator's portion has the reserve SPI."""
    whole = directives.pack(NewKey(2, 2, bytes(range(32))), 1)
    first = Portion(2, 1, whole.ljust(72, b"\0"))
    link.terminal.send(directives.pack(first, 1))
    counter = link.terminal.send(directives.pack(Portion(2, 2, bytes(72)), 2), spi=2)
    link.turn()
    assert link.stages(counter, spi=2) == ["refused"]
    assert link.status()["generation"].tolist() == [1, 1, 1, 1]


def test_a_new_key_of_telemetry_is_followed_by_the_ground(link: BothEnds) -> None:
    old = link.ground.read(3)
    assert old is not None
    following = replace(old, generation=2, unused=0, key=bytes(range(32)))
    link.ground.write(following, "3-next")
    change = link.terminal.send(directives.pack(NewKey(3, 2, following.key), 1))
    link.turn()
    assert link.stages(change) == ["accepted", "completed"]
    assert (link.ground.read(3) or old).generation == 2
    assert link.ground.read("3-next") is None


def test_without_counters_of_telemetry_the_reserve_serves_and_commands_always_come(link: BothEnds) -> None:
    for spi, survives in ((3, True), (4, False)):
        link.sky.remove(spi)
        link.restart()
        link.packets.clear()
        counter = link.terminal.send(packet(Ping(1), spi))
        link.turn()
        assert bool(link.packets) is survives
        assert len(link.obeyed) == spi - 2
        assert (link.stages(counter)[-1:] == ["completed"]) is survives


def test_frames_that_were_protected_are_sent_before_the_counters_end() -> None:
    counters = iter(range(3))

    def seal(header: bytes, data: bytes) -> bytes:
        if next(counters, None) is None:
            raise KnightCubeError("no counter")
        return header + bytes(14) + data + bytes(16)

    downlink = Downlink(1, 128, 1e5, seal, lambda: None)
    for _ in range(20):
        downlink.report(idle_packet(120))
    downlink.frames(0)
    assert len(downlink.frames(SECOND_NS)) == 3
    with pytest.raises(KnightCubeError):
        downlink.frames(2 * SECOND_NS)


def test_telemetry_returns_at_the_rate_of_the_line_after_a_time_without_keys() -> None:
    """After a minute without keys, frames of 128 bytes are sent at 1200 bytes/s, not faster."""
    keys: list[str] = []

    def seal(header: bytes, data: bytes) -> bytes:
        if not keys:
            raise KnightCubeError("no key")
        return header + bytes(14) + data + bytes(16)

    downlink = Downlink(1, 128, 1200.0, seal, lambda: None)
    for number in range(600):
        downlink.report(idle_packet(120))
        with suppress(KnightCubeError):
            downlink.frames(number * SECOND_NS // 10)
    keys.append("a key")
    made = [len(downlink.frames(60 * SECOND_NS + number * SECOND_NS // 50)) for number in range(51)]
    assert 8 <= sum(made) <= 12
    assert sum(made[26:]) >= 4


def test_a_playback_frame_that_could_not_be_protected_waits_for_a_listener() -> None:
    keys: list[str] = []

    def seal(header: bytes, data: bytes) -> bytes:
        if not keys:
            raise KnightCubeError("no key")
        return header + bytes(14) + data + bytes(16)

    downlink = Downlink(1, 128, 1e5, seal, lambda: None)
    downlink.play(iter([idle_packet(120)]))
    downlink.frames(0)
    with pytest.raises(KnightCubeError):
        downlink.frames(SECOND_NS)
    keys.append("a key")
    assert downlink.frames(2 * SECOND_NS, live_only=True) == []
    assert downlink.frames(3 * SECOND_NS)


@pytest.mark.parametrize("damage", [b"", b"\0", b"x" * 40])
def test_damaged_directives_are_refused_in_words(damage: bytes) -> None:
    good = directives.pack(Play(0, 1.0, 2.0), 5)
    assert directives.unpack(good) == Play(0, 1.0, 2.0)
    with pytest.raises(CommandError):
        directives.unpack(good[: 6 + len(damage)] + damage)
    with pytest.raises(CommandError, match="the end 1 s must not be before the begin 2 s"):
        directives.pack(Play(0, 2.0, 1.0), 5)
    with pytest.raises(CommandError, match="from nan to 5 s: give two numbers"):
        directives.pack(Play(0, math.nan, 5.0), 5)
    with pytest.raises(CommandError, match="number = -1 cannot be stored as u4"):
        directives.pack(Deletion(-1), 5)
    fields = {"run": 0, "begin": 2.0, "end": 1.0}
    backwards = Packer(directives.LAYOUTS).pack(Play.packet, 5, fields)
    assert crc16(backwards[:-CRC_BYTES]) == int.from_bytes(backwards[-CRC_BYTES:], "big")
    with pytest.raises(CommandError, match="must not be before the begin"):
        directives.unpack(backwards)
