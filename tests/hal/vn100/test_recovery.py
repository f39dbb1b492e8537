"""Tests that a lost VN-100 is found and configured again within two seconds, and that polls do not block."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from hal.drivers.vn100_protocol import build
from hal.interfaces.devices import ImuReading
from hal.interfaces.errors import NotResponding
from sim_hal.emulators.serial_line import SOUND, LineFaults
from sim_hal.emulators.vn100_sensors import Vn100Sample
from tests.hal.vn100.bench_line import BenchLine, bench_line

PERIOD_NS = 25_000_000


@pytest.fixture
def bench() -> BenchLine:
    made = bench_line()
    made.driver.configure()
    made.run(1.0)
    return made


def poll(bench: BenchLine) -> list[ImuReading]:
    """Poll once at the next cycle. A missing port gives no readings.

    Simulated time must not advance during a poll.
    """
    bench.clock.sleep_until_ns(bench.clock.now_ns() + PERIOD_NS)
    before_ns = bench.clock.now_ns()
    try:
        return bench.driver.poll()
    except NotResponding:
        return []
    finally:
        assert bench.clock.now_ns() == before_ns, "a poll that waits"


def seconds_until_readings(bench: BenchLine, limit: float = 5.0) -> float:
    """Return the time (s) until a reading arrives in each cycle."""
    begin_ns = bench.clock.now_ns()
    in_a_row = 0
    while (bench.clock.now_ns() - begin_ns) * 1e-9 < limit:
        in_a_row = in_a_row + 1 if poll(bench) else 0
        if in_a_row == 8:
            return (bench.clock.now_ns() - begin_ns) * 1e-9 - 8 * 0.025
    return float("inf")


def reset(bench: BenchLine) -> None:
    bench.line.host.send(build("RST"))
    bench.run(1.0)  # the VN-100 boots, and the fault has ended before it sends data


def lose_power(bench: BenchLine) -> None:
    bench.unit.switch_off()
    bench.run(5.0)
    bench.unit.switch_on(bench.clock.now_ns())
    bench.run(1.0)


def unplug(bench: BenchLine) -> None:
    bench.line.host.unplugged = True
    for _ in range(80):
        assert poll(bench) == []
    bench.line.host.unplugged = False


def unplug_with_its_power(bench: BenchLine) -> None:
    bench.unit.switch_off()
    unplug(bench)
    bench.unit.switch_on(bench.clock.now_ns())
    bench.run(1.0)


def line_fault(faults: LineFaults) -> Callable[[BenchLine], None]:
    def happen(bench: BenchLine) -> None:
        bench.line.to_host.faults = faults
        bench.run(3.0)
        bench.line.to_host.faults = SOUND

    return happen


def both_ways(bench: BenchLine) -> None:
    bench.line.to_device.faults = LineFaults(garbage=True)
    line_fault(LineFaults(garbage=True))(bench)
    bench.line.to_device.faults = SOUND


def change_speed(baud_rate: int) -> Callable[[BenchLine], None]:
    return lambda bench: bench.unit.change_baud_rate(baud_rate, bench.clock.now_ns())


@pytest.mark.parametrize(
    "happen",
    [
        reset,
        lose_power,
        unplug,
        unplug_with_its_power,
        line_fault(LineFaults(silent=True)),
        line_fault(LineFaults(garbage=True)),
        line_fault(LineFaults(delay_ns=400_000_000)),
        both_ways,
        change_speed(230400),
        change_speed(921600),
        change_speed(57600),
        change_speed(38400),
    ],
    ids=[
        "reset",
        "power",
        "unplugged",
        "unplugged with its power",
        "silence",
        "garbage",
        "delay",
        "garbage both ways",
        "230400",
        "921600",
        "57600",
        "38400",
    ],
)
def test_readings_come_again_within_two_seconds_after_the_fault(
    bench: BenchLine, happen: Callable[[BenchLine], None]
) -> None:
    happen(bench)
    assert seconds_until_readings(bench) <= 2.0
    assert bench.unit.registers.read(85)[:3] == ("20", "20", "20"), "set up as for the mission"
    assert bench.line.host.baud_rate == bench.line.device.baud_rate == 115200
    assert len(bench.run(1.0)) >= 39


def test_a_unit_with_saved_binary_output_is_set_up_again_after_a_reset(bench: BenchLine) -> None:
    """After a reset, a VN-100 that resumes its saved binary output is configured again.

    The packets continue without a command, so only the device clock shows the reset.
    """
    bench.unit.registers.save()
    bench.unit.registers.write(85, ("0", "4", "4", "4", "0", "0", "3", "3", "3", "0"))
    bench.unit.registers.save()
    reset(bench)
    bench.run(1.5)
    assert bench.driver.resets == 1
    assert (bench.driver.link().upsets, "has restarted" in bench.driver.link().upset) == (1, True)
    assert bench.unit.registers.read(85)[:3] == ("20", "20", "20")


def test_a_healthy_unit_gets_no_commands(bench: BenchLine) -> None:
    sent: list[bytes] = []
    bench.line.host.send = sent.append  # type: ignore[method-assign,assignment]  # records the calls
    bench.run(20.0)
    assert sent == []
    assert bench.driver.recoveries == 0


def test_noise_that_leaves_readings_starts_no_recovery(bench: BenchLine) -> None:
    bench.line.to_host.faults = LineFaults(flip_probability=3e-4, cut_probability=0.1)
    assert len(bench.run(20.0)) > 500
    assert bench.driver.recoveries == 0


def test_values_that_never_change_are_not_accepted_as_readings(bench: BenchLine) -> None:
    kept: list[Vn100Sample] = []

    def same(measured: Vn100Sample) -> Vn100Sample:
        kept.append(measured)
        return kept[0]

    bench.unit.alter = same
    before = bench.driver.link().out_of_range
    bench.run(2.0)
    assert bench.run(1.0) == []
    assert bench.driver.link().out_of_range - before > 80
    bench.unit.alter = None
    assert seconds_until_readings(bench) <= 2.0


def test_readings_are_not_lost_if_a_command_cannot_be_sent(
    bench: BenchLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: bytes) -> None:
        raise NotResponding("line", "the output queue is full")

    monkeypatch.setattr(bench.line.host, "send", full)
    bench.driver._recovery.reset("a restart")
    assert len(bench.run(1.0)) >= 39


def test_each_baud_rate_is_tried_although_the_port_rejects_one(bench: BenchLine) -> None:
    tried: set[int] = set()
    bench.line.host.rejected_rate = 230400
    bench.line.to_host.faults = LineFaults(garbage=True)
    for _ in range(400):
        poll(bench)
        tried.add(bench.line.host.baud_rate)
    assert {230400, 921600, 460800} <= tried


def test_a_unit_that_refuses_is_asked_again_a_second_later_and_not_at_every_cycle(bench: BenchLine) -> None:
    bench.unit.registers.values[1] = ("VN-200T-CR",)
    asked: list[bytes] = []
    send = bench.line.host.send

    def listen(data: bytes) -> None:
        asked.append(data)
        send(data)

    bench.line.host.send = listen  # type: ignore[method-assign]  # records the calls
    bench.unit.registers.write(75, ("0", "20", "01", "0001"))
    bench.unit._build_streams(bench.clock.now_ns())
    bench.run(5.0)
    assert 3 <= len(asked) <= 6


def test_the_driver_of_a_unit_with_other_settings_recovers_too() -> None:
    made = bench_line()
    ascii_line = replace(made.driver._settings, output="ascii")
    made.driver.__init__(made.line.host, made.clock, ascii_line)  # type: ignore[misc]  # other settings
    made.driver.configure()
    made.run(0.5)
    reset(made)
    assert seconds_until_readings(made) <= 2.0
