"""The link process: commands go over once and are verified; telemetry comes live and from the archive."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from flight.link.commands.codec import CommandPacker, unpack
from flight.link.commands.errors import CommandError
from flight.link.commands.values import ChangeMode, Command, Ping, Slew
from flight.link.modes import Mode
from flight.link.process import directives
from flight.link.process.directives import NewKey, Play, Stop
from flight.link.process.downlink import LIVE, PLAYBACK
from flight.link.telemetry.definitions import CYCLE_TIMING, EVENT
from flight.link.telemetry.packets import CRC_BYTES, LAYOUTS, crc16
from tests.flight.link.process.both_ends import BothEnds
from tests.flight.link.telemetry.samples import plain_contents, timing_packets


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


def test_refusals_and_the_highest_counter_stand_in_the_very_first_packet(link: BothEnds) -> None:
    frame_of = link.terminal.send(packet(Ping(1)))
    frame = link.wire.up[0]
    link.turn()
    link.restart()
    link.packets.clear()
    link.wire.up += [frame, frame[:-1] + b"x"]
    link.turn(1.1)
    assert link.packets[0][1][:2] == LAYOUTS["link"].identifier.to_bytes(2, "big")
    (first,) = LAYOUTS["link"].array(link.packets[0][1])
    assert first["highest"].tolist() == [frame_of, -1]
    assert len(link.obeyed) == 1, "the restarted link has obeyed the old frame again"
    assert link.status()[["refused_repeated", "refused_crc"]].tolist() == (1, 1)
    assert link.stages(frame_of)[-1] == "refused"


def test_live_packets_come_in_order_and_none_is_lost(link: BothEnds) -> None:
    sent = timing_packets(300)
    for begin in range(0, 300, 30):
        link.record(*sent[begin : begin + 30])
        link.turn(0.1)
    link.turn()
    assert link.of("cycle_timing") == sent
    assert link.terminal.lost_frames == 0


def test_a_slow_line_thins_what_repeats_and_loses_no_event(tmp_path: Path) -> None:
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


def test_a_stretch_of_the_archive_is_played_back_whole_beside_live_telemetry(link: BothEnds) -> None:
    old = timing_packets(4000)  # several segments
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


def test_a_new_key_makes_the_old_one_worthless(link: BothEnds) -> None:
    key = bytes(range(32))
    change = link.terminal.send(directives.pack(NewKey(1, 2, key), 1))
    stale = link.terminal.send(directives.pack(NewKey(2, 7, key), 1))
    link.turn()
    assert link.stages(change) == ["accepted", "completed"]
    assert link.stages(stale) == []  # came under the old key
    assert link.status()["refused_mac"] == 1
    late = link.terminal.send(directives.pack(NewKey(2, 7, key), 1), spi=2)
    link.turn()
    assert link.stages(late, spi=2) == ["accepted", "failed"]
    assert link.status()["generation"].tolist() == [2, 1, 1, 1]


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


@pytest.mark.parametrize("damage", [b"", b"\0", b"x" * 40])
def test_damaged_directives_are_refused_in_words(damage: bytes) -> None:
    good = directives.pack(Play(0, 1.0, 2.0), 5)
    assert directives.unpack(good) == Play(0, 1.0, 2.0)
    with pytest.raises(CommandError):
        directives.unpack(good[: 6 + len(damage)] + damage)
    backwards = directives.pack(Play(0, 2.0, 1.0), 5)
    assert crc16(backwards[:-CRC_BYTES]) == int.from_bytes(backwards[-CRC_BYTES:], "big")
    with pytest.raises(CommandError, match="no stretch of time"):
        directives.unpack(backwards)
