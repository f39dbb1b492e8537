"""Tests that a bring-up session opens its devices, and recognises chips and serial devices."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from flight.schema import reader
from flight.schema.devices import Battery, Power, PowerMonitorSection
from ground.bringup import bench
from ground.bringup.bench import Outcome, Session, StepSkipped, chip_at, talker
from ground.bringup.diagnosis import Finding
from ground.bringup.session import step_find
from hal.drivers.vn100 import BAUD_RATES
from hal.drivers.vn100_protocol import build
from hal.interfaces.errors import NotResponding
from hal.interfaces.wires import SECOND_NS
from sim_hal.clock import SimClock
from tests.support.bench_session import ScriptedCamera, ScriptedUnit, bench_session
from tests.support.orbit_devices import orbit_config


def _session(power: Power | None) -> Session:
    """Return a bring-up session without hardware."""
    config = reader.replace(orbit_config(), power=power)
    return Session(config, Mock(cameras=None), ExitStack(), lambda _: None)


def test_a_monitor_of_the_power_system_has_its_section_if_it_is_configured() -> None:
    monitor = PowerMonitorSection(address=0x45)
    power = Power(battery=Battery(capacity=2.0), battery_monitor=monitor, bus_monitor=None)
    assert _session(power).section("power.battery_monitor") == ("power_monitor", monitor)
    assert _session(power).section("power.bus_monitor") == ("power_monitor", None)
    assert _session(None).section("power.battery_monitor") == ("power_monitor", None)


@pytest.mark.parametrize("key", ["power.battery_monitor", "power.bus_monitor"])
def test_a_step_with_a_monitor_that_is_not_configured_is_skipped(key: str) -> None:
    with pytest.raises(StepSkipped, match=f"the configuration has no {key}"):
        _session(None).device(key)


# Frames and samples.

PIXELS = np.arange(12, dtype=np.uint16).reshape(3, 4)


def with_camera(*pictures: Any, late_s: float = 0.1) -> tuple[Session, ScriptedCamera]:
    device = ScriptedCamera(lambda: session, *pictures, late_s=late_s)
    session = bench_session({"camera": device})
    return session, device


@pytest.mark.parametrize(
    ("pictures", "count", "taken", "said"),
    [
        ([PIXELS], 3, [1, 2, 3], None),
        ([None, PIXELS], 2, [2, 3], "1 of 3 triggers give no frame (no frame for trigger 1)"),
        ([PIXELS, None, None, PIXELS], 2, [1, 4], "2 of 4 triggers give no frame (no frame for trigger 2)"),
        ([PIXELS, None, None, None, PIXELS], 2, [1], "3 of 4 triggers give no frame"),
    ],
)
def test_lost_frames_are_triggered_again_and_reported(
    pictures: list[Any], count: int, taken: list[int], said: str | None
) -> None:
    session, device = with_camera(*pictures)
    findings: list[Finding] = []
    assert [frame.sequence for frame in session.frames(count, findings)] == taken
    assert len(device.triggers) <= count + 2
    assert [(one.part, one.kind) for one in findings] == ([("camera", "intermittent")] if said else [])
    assert all(said is not None and said in one.text for one in findings)


def test_a_camera_that_a_trigger_has_lost_is_triggered_again_when_it_is_open_again() -> None:
    """A real camera is reopened a second after a lost frame, and refuses triggers until then."""

    class Reopened(ScriptedCamera):
        open_ns = 0

        def trigger(self, exposure_ns: int) -> None:
            if self.session().rig.clock.now_ns() < self.open_ns:
                raise NotResponding("camera", "it is being opened")
            super().trigger(exposure_ns)

        def poll(self) -> Any:
            try:
                return super().poll()
            except NotResponding:
                self.open_ns = self.session().rig.clock.now_ns() + round(1.1 * SECOND_NS)
                raise

    device = Reopened(lambda: session, PIXELS, None, PIXELS)
    session = bench_session({"camera": device})
    findings: list[Finding] = []
    assert [frame.sequence for frame in session.frames(3, findings)] == [1, 3, 4]
    assert [one.text for one in findings] == ["1 of 4 triggers give no frame (no frame for trigger 2)"]


def test_a_camera_without_frames_is_given_up_after_two_triggers() -> None:
    session, device = with_camera(None)
    with pytest.raises(StepSkipped, match="camera delivers no frame") as ended:
        session.frames(3, [])
    assert ended.value.finding is not None
    assert ended.value.finding.text == "no frame for trigger 1"
    assert len(device.triggers) == 2


@pytest.mark.parametrize(("late_s", "kinds"), [(1.9, []), (2.1, ["late"])])
def test_a_frame_is_late_two_seconds_after_its_exposure(late_s: float, kinds: list[str]) -> None:
    findings: list[Finding] = []
    with_camera(PIXELS, late_s=late_s)[0].frames(1, findings)
    assert [one.kind for one in findings] == kinds
    assert all(one.text == "a frame arrives 2.1 s after its exposure" for one in findings)


def test_a_trigger_waits_twelve_seconds_for_its_frame() -> None:
    class Silent(ScriptedCamera):
        def poll(self) -> Any:
            return None

    device = Silent(lambda: session, PIXELS)
    session = bench_session({"camera": device})
    with pytest.raises(StepSkipped) as ended:
        session.frames(1, [])
    assert "within 12 s of the trigger" in str(ended.value.finding)
    assert session.rig.clock.now_ns() == pytest.approx(24.0 * SECOND_NS, abs=0.1 * SECOND_NS)


def still(number: int) -> tuple[Any, Any, Any]:
    return np.array([number, 0.0, 1.0]), np.array([2e-5, 0.0, number]), np.array([0.0, number, 9.8])


def test_a_record_has_the_samples_of_its_span_in_order() -> None:
    unit = ScriptedUnit(lambda: session, still)
    session = bench_session({"inertial_unit": unit})
    session.wait(1.0)
    calls: list[int] = []
    samples = session.record(0.5, lambda: calls.append(session.rig.clock.now_ns()))
    assert samples.times == pytest.approx(1.0 + 0.025 * np.arange(1, 21))
    assert samples.rate[:, 0] == pytest.approx(np.arange(41.0, 61.0))
    assert samples.field[:, 2] == pytest.approx(np.arange(41.0, 61.0))
    assert samples.acceleration[:, 1] == pytest.approx(np.arange(41.0, 61.0))
    assert calls == [SECOND_NS + 25_000_000 * k for k in range(20)]
    assert session.rig.clock.now_ns() == 1.5 * SECOND_NS


@pytest.mark.parametrize(
    ("seconds", "counts", "kind", "text"),
    [
        (0.5, {"out_of_range": 20}, None, ""),
        (0.5, {"out_of_range": 21, "rejection": "rate 99"}, "impossible values",
         "21 samples are rejected: rate 99"),
        (0.5, {"out_of_range": 21, "rejection": "identical samples"}, "stuck", "identical samples"),
        (0.05, {"packets": 7}, "no samples", "2 valid samples and 7 packets in 0.05 s"),
        (0.075, {}, None, ""),
        (0.05, {"out_of_range": 3, "packets": 2}, "no samples", "2 valid samples"),
        (0.05, {"out_of_range": 4}, "impossible values", "4 samples are rejected"),
    ],
)  # fmt: skip
def test_rejected_and_missing_samples_end_the_step(
    seconds: float, counts: dict[str, Any], kind: str | None, text: str
) -> None:
    unit = ScriptedUnit(lambda: session, still, **counts)
    session = bench_session({"inertial_unit": unit})
    session.wait(1.0)
    if kind is None:
        assert len(session.record(seconds).times) == round(seconds * 40.0)
        return
    with pytest.raises(StepSkipped) as ended:
        session.record(seconds)
    assert ended.value.finding is not None
    assert (ended.value.finding.part, ended.value.finding.kind) == ("inertial_unit", kind)
    assert text in ended.value.finding.text


# Open devices.


def test_a_device_is_opened_at_most_three_times_and_then_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    tries: list[str] = []

    def opened(session: Session, key: str, kind: str, section: Any) -> str:
        tries.append(f"{key} {kind}")
        if len(tries) < 3:
            raise NotResponding(key, "silent")
        return "the device"

    monkeypatch.setattr(Session, "_opened", opened)
    session = bench_session({})
    assert session.device("gps") == "the device"
    assert session.device("gps") == "the device"
    assert tries == ["gps gps"] * 3
    tries.clear()
    monkeypatch.setattr(Session, "_opened", lambda *words: _refuse(tries))
    with pytest.raises(StepSkipped, match="coils could not be opened") as ended:
        session.device("coils")
    assert len(tries) == 3
    assert ended.value.finding is not None
    assert (ended.value.finding.kind, ended.value.finding.text) == ("refused", "broken")


def test_a_device_that_does_not_start_is_not_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A unit that consists of separate sensors reads them in its own thread until the end of the session."""
    refused = NotResponding("lis3mdl", "no acknowledge")
    unit = Mock(configure=Mock(side_effect=[refused, refused, None]))
    driver = Mock(open=Mock(side_effect=[unit]))
    monkeypatch.setattr(bench, "driver_of", lambda *_: driver)
    assert bench_session({}).device("inertial_unit") is unit
    driver.open.assert_called_once()


def _refuse(tries: list[str]) -> None:
    tries.append("coils")
    raise NotResponding("coils", "broken")


def test_a_device_that_was_not_found_is_not_opened() -> None:
    session = bench_session({})
    session.known["find"] = Outcome(
        [Finding("gps", "no answer", "", ""), Finding("coils", "exchanged", "", "")]
    )
    with pytest.raises(StepSkipped, match=r"coils was not found \(exchanged\)"):
        session.device("coils")


def test_the_emulated_cameras_are_numbered_after_the_star_camera() -> None:
    session = bench_session({})
    rig: Any = session.rig
    rig.cameras = ("star", "first", "second")
    assert [session.device(key) for key in ("camera", "wide_cameras[0]", "wide_cameras[1]")] == [
        "star",
        "first",
        "second",
    ]
    assert session.section("wide_cameras[1]") == ("camera", session.config.wide_cameras[1])
    assert session.section("coils") == ("coils", session.config.coils)


def test_a_camera_that_the_search_has_opened_can_be_opened_by_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search closes a camera, because a second opening of a streaming camera is refused as busy."""
    in_use: list[str] = []

    def opened(section: Any, rig: Any, stack: ExitStack) -> str:
        if in_use:
            raise NotResponding("camera", "another program uses the camera")
        in_use.append("camera")
        stack.callback(in_use.clear)
        return "open camera"

    monkeypatch.setattr(bench, "open_camera", opened)
    monkeypatch.setattr(bench, "fitted_devices", lambda _: [])
    session = bench_session({}, wide_cameras=())
    session.known["find"] = step_find(session)
    assert session.known["find"].findings == []
    assert session.device("camera") == "open camera"
    session.stack.close()
    assert in_use == []


def test_closing_sets_the_coils_to_zero_before_the_devices_are_closed() -> None:
    done: list[str] = []
    session = bench_session({"coils": Mock(off=lambda: done.append("off"))})
    session.stack.callback(done.append, "closed")
    session.close()
    bench_session({}).close()
    assert done == ["off", "closed"]


# Chips and serial lines.


class Chip:
    """I2C bus with one chip of given registers at the address 0x40."""

    def __init__(self, registers: dict[int, int], word: int) -> None:
        self.registers, self.word = registers, word

    def read_byte_data(self, address: int, register: int) -> int:
        if address != 0x40:
            raise OSError("no answer")
        return self.registers.get(register, 0)

    def read_i2c_block_data(self, address: int, register: int, count: int) -> list[int]:
        assert (register, count) == (0, 2)
        return [self.word >> 8, self.word & 0xFF]


PCA9685 = {2: 0xE2, 3: 0xE4, 4: 0xE8, 5: 0xE0}
"""Registers SUBADR1 to ALLCALLADR after power-on (data sheet, Table 4)."""


@pytest.mark.parametrize(
    ("registers", "word", "kind"),
    [
        (PCA9685, 0, "pca9685"),
        (PCA9685 | {5: 0xE1}, 0x399F, "ina219"),
        ({}, 0x399F, "ina219"),
        ({}, 0x399E, ""),
        ({}, 0x9F39, ""),
    ],
)
def test_a_chip_is_recognised_by_its_registers(registers: dict[int, int], word: int, kind: str) -> None:
    bus: Any = Chip(registers, word)
    assert chip_at(bus, 0x40) == kind
    assert chip_at(bus, 0x41) is None


REFUSED_RATE = 123


class Line:
    """Serial line that sends chunks at given times (s) at one baud rate, and noise at other rates."""

    def __init__(self, clock: SimClock, rate: int, chunks: Iterator[tuple[float, bytes]]) -> None:
        self.clock, self.rate, self.chunks = clock, rate, list(chunks)
        self.now = 0
        self.rates: list[int] = []

    def set_baud_rate(self, rate: int) -> None:
        self.now = rate
        self.rates.append(rate)
        self.begun = self.last = self.clock.now_ns()
        if rate == REFUSED_RATE:
            raise NotResponding("line", "does not support this baud rate")

    def receive(self) -> list[tuple[int, bytes]]:
        now, last = self.clock.now_ns(), self.last
        self.last = now
        due = [(self.begun + round(at * SECOND_NS), data) for at, data in self.chunks]
        return [one for one in due if last < one[0] <= now] if self.now == self.rate else []


def identified(
    rate: int, *chunks: tuple[float, bytes], rates: tuple[int, ...] = (9600,)
) -> tuple[Any, list[int]]:
    """Return the device that sends on a line, and the baud rates that were tried."""
    clock = SimClock()
    line = Line(clock, rate, iter(chunks))
    rig: Any = Mock(clock=clock)
    rig.wires.serial = lambda device, rate: line
    return talker(rig, "/dev/line", rates), line.rates


def every(period: float, data: bytes, *gaps: tuple[float, float]) -> list[tuple[float, bytes]]:
    """Return chunks at equal intervals from 0.01 s to 1.2 s, without those in the gaps."""
    times = 0.01 + period * np.arange(int(1.18 / period))
    return [(float(t), data) for t in times if not any(begin < t < end for begin, end in gaps)]


UBX = b"\xb5\x62\x01\x07"


def test_the_kind_of_a_serial_device_is_recognised_at_its_baud_rate() -> None:
    assert identified(9600, *every(0.05, b"$VNYMR,"))[0] == ("vn100", 9600, 0.0)
    found, rates = identified(57600, *every(0.05, b"$VNYMR,"), rates=(9600, 38400))
    assert found == ("vn100", 57600, 0.0)
    assert rates[:2] == [9600, 38400]
    assert len(rates) == len(set(rates)), "no rate is tried twice"
    assert identified(9600, *every(0.5, UBX))[0] == ("gps", 9600, 0.0)
    assert identified(9600, *every(0.5, b"$GNGGA"))[0] == ("gps", 9600, 0.0)
    assert identified(9600, *every(0.5, b"$GPGGA"))[0] == ("gps", 9600, 0.0)
    nothing, rates = identified(1, rates=(4800,))
    assert nothing == ("", 0, 0.0)
    assert rates == [4800, *BAUD_RATES]


def test_a_receiver_that_a_flight_has_configured_may_send_rarely() -> None:
    """A receiver keeps the period that its last flight configured, so its pauses can exceed 1.2 s."""
    clock = SimClock()
    line = Line(clock, 9600, iter([(4.5, UBX)]))
    rig: Any = Mock(clock=clock)
    rig.wires.serial = lambda device, rate: line
    assert talker(rig, "/dev/line", (9600,), 5 * SECOND_NS) == ("gps", 9600, 0.0)
    assert talker(rig, "/dev/line", (38400, 9600), 5 * SECOND_NS) == ("", 0, 0.0)
    assert line.rates[:1] == [9600]


def test_a_pause_of_five_usual_pauses_is_a_loose_contact() -> None:
    """Lines arrive every 0.05 s; the port is read every 0.02 s."""
    line = build("YMR", 1)
    loose, _ = identified(9600, *every(0.05, line, (0.4, 0.75)))
    assert loose == ("vn100", 9600, pytest.approx(0.4, abs=0.02))
    assert identified(9600, *every(0.05, line, (0.4, 0.57)))[0] == ("vn100", 9600, 0.0)
    few = [*every(0.16, line)[:2], (1.15, line)]
    assert identified(9600, *few)[0] == ("vn100", 9600, 0.0), "too few pauses"


def test_the_chunks_in_which_a_port_delivers_a_line_are_not_loose_contacts() -> None:
    """The buffer of a UART delivers a line in several chunks, between which the pauses are short."""
    line = build("YMR", 1)
    chunks = [(at + 0.001 * k, line[k : k + 1]) for at, _ in every(0.05, line) for k in range(len(line))]
    assert identified(9600, *chunks)[0] == ("vn100", 9600, 0.0)
    loose, _ = identified(9600, *(one for one in chunks if not 0.4 < one[0] < 0.75))
    assert loose == ("vn100", 9600, pytest.approx(0.4, abs=0.02))


def test_a_baud_rate_that_the_port_refuses_does_not_end_the_search() -> None:
    found, rates = identified(57600, *every(0.05, b"$VNYMR,"), rates=(REFUSED_RATE,))
    assert found == ("vn100", 57600, 0.0)
    assert rates[0] == REFUSED_RATE


def test_a_lost_serial_port_has_no_device() -> None:
    rig: Any = Mock(clock=SimClock())

    def serial(device: str, rate: int) -> None:
        raise NotResponding("gps", "the port is lost")

    rig.wires.serial = serial
    assert talker(rig, "/dev/line", (9600,)) == ("", 0, 0.0)
