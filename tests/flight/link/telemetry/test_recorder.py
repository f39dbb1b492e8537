"""Tests that the recorder writes two logs in mission time, and counts values that are out of range."""

from __future__ import annotations

from flight.link import events
from flight.link.telemetry.definitions import CYCLE_TIMING, TARGET
from flight.link.telemetry.log import Recorder
from ground.telemetry import decode


class Memory:
    """A test double of a log that keeps packets in memory."""

    def __init__(self) -> None:
        self.packets: list[bytes] = []

    def write(self, packet: bytes) -> None:
        """Keep a packet."""
        self.packets.append(packet)


def test_a_record_goes_to_its_log_in_mission_time_and_is_the_newest_of_its_type() -> None:
    flight, performance = Memory(), Memory()
    recorder = Recorder(flight, performance)
    recorder.epoch_ns = 100
    assert recorder.newest(TARGET) == b""
    packed = recorder.record(TARGET, 105, index=1, q2=0.1, rate=0.0)
    recorder.time(CYCLE_TIMING, 107, cycle=3, lateness=0.0, execution=0.001)
    assert packed is not None
    assert flight.packets == [packed]
    assert recorder.newest(TARGET) == packed
    assert decode(packed)["target"]["time_ns"].tolist() == [5]
    (timing,) = performance.packets
    assert decode(timing)["cycle_timing"][["time_ns", "cycle"]].tolist() == [(7, 3)]
    assert (recorder.lost, recorder.lost_text) == (0, "")


def test_a_record_that_does_not_fit_is_counted_and_written_nowhere() -> None:
    flight, performance = Memory(), Memory()
    recorder = Recorder(flight, performance)
    assert recorder.record(TARGET, 0, index=-1, q2=0.1, rate=0.0) is None
    recorder.time(CYCLE_TIMING, 0, cycle=-1, lateness=0.0, execution=0.0)
    assert flight.packets == performance.packets == []
    assert recorder.lost == 2
    assert "cycle = -1" in recorder.lost_text
    assert recorder.newest(TARGET) == b""


def test_the_status_has_the_newest_events_without_those_of_obeyed_commands() -> None:
    recorder = Recorder(Memory(), Memory())
    recorder.event(events.BLIND, 1, 4, "dark")
    recorder.event(events.COMMANDED, 2, 0, "ping")
    rows = decode(recorder.status())["event"]
    assert rows[["code", "severity", "suppressed", "name", "text"]].tolist() == [
        (22, 2, 4, b"blind", b"dark")
    ]
