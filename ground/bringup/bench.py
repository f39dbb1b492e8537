"""Devices of a bench session: search for devices, opening of devices, and outcomes of steps.

The driver sets a coil to zero if its command is not repeated within 0.25 s. The guardian sets all coils to
zero if this process stops. `Session.close` sets all coils to zero at the end of every session. If a chip does
not answer, all addresses of its bus are searched for it. If a serial device does not answer, its serial line
is listened to at all baud rates, to find which device sends there. Chips are identified by registers that no
driver changes.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from flight.app.devices import open_camera
from flight.schema.devices import driver_of, fitted_devices
from flight.schema.sections import Config
from ground.bringup.diagnosis import Finding, Samples
from hal.drivers.current_monitors import BUS_32_V, config_for
from hal.drivers.gps import BAUD_RATES as GPS_BAUD_RATES
from hal.drivers.vn100 import BAUD_RATES
from hal.drivers.vn100_protocol import StreamParser
from hal.interfaces.devices import Frame, FrameSource, ImuReading, InertialUnit, TorqueCoils
from hal.interfaces.errors import DeviceError, NotResponding, Refused
from hal.interfaces.guardian import CoilGuardian, GuardianNews
from hal.interfaces.wires import SECOND_NS, I2cBus, Rig
from knightcube.astro.arrays import FloatArray, Image

_POLL_NS = 25_000_000
_FRAME_PATIENCE_NS = 12 * SECOND_NS
_REOPENING_NS = 3 * SECOND_NS
_ATTEMPTS = 3
"""Number of attempts to open a device, so that the measurement can begin despite a loose contact."""
_LOST_FRAMES = 2  # number of additional triggers if a trigger yields no frame
_LATE_FRAME_S = 2.0  # longest time (s) from the end of an exposure to the arrival of the frame
STILL_S = 0.5
"""Duration (s) of a measurement of the body at rest."""


class StepSkipped(Exception):
    """Raised if a step of the bring-up cannot be performed.

    The message states the reason. The attribute `finding` is the fault that prevents the step, or None.
    """

    def __init__(self, reason: str, finding: Finding | None = None) -> None:
        super().__init__(reason)
        self.finding = finding


@dataclass(slots=True)
class Outcome:
    """The result of a step.

    Attributes:
        findings: diagnosed faults of the devices.
        values: measured values for the report and for JSON.
        changes: configuration values derived from the measurements, by section.
        arrays: measured arrays for the plots.
        frames: camera frames for the report.
    """

    findings: list[Finding] = field(default_factory=list)
    values: dict[str, Any] = field(default_factory=dict)
    changes: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, Any] = field(default_factory=dict)
    frames: dict[str, Image] = field(default_factory=dict)


@dataclass(slots=True)
class Session:
    """The open devices of a session.

    Attributes:
        config: configuration of the devices.
        rig: hardware or emulated devices.
        stack: exit stack that closes every opened device.
        ask: function that requests an action of the person at the bench and waits for its completion.
        hand: emulation of the person at the bench (`sim_hal.rig.EmulatedBench`), or None at a real bench.
        guardian: guardian of the coils, or None with emulated devices.
        coil_field: expected field per ampere (n, 3), T/A, of each coil at the magnetometer, in body axes, or
            None if the configuration does not describe it.
        known: outcomes of earlier steps, by name.
        live: function that shows a text while the focus is adjusted and returns whether to continue, or None
            if nobody adjusts the focus.
    """

    config: Config
    rig: Rig
    stack: ExitStack
    ask: Callable[[str], None]
    hand: Any = None
    guardian: CoilGuardian | None = None
    coil_field: FloatArray | None = None
    known: dict[str, Outcome] = field(default_factory=dict)
    live: Callable[[str], bool] | None = None
    _open: dict[str, Any] = field(default_factory=dict)
    _lost: int = 0
    _guarding: threading.Lock = field(default_factory=threading.Lock)

    def device(self, key: str) -> Any:
        """Return the open device of a section, such as `gps`, `power.bus_monitor` or `wide_cameras[1]`.

        Raises StepSkipped if the device is not configured or not found.
        """
        if key not in self._open:
            missing = [one for one in self.known.get("find", Outcome()).findings if one.part == key]
            if missing:
                raise StepSkipped(f"{key} was not found ({missing[0].kind})")
            kind, section = self.section(key)
            if section is None:
                raise StepSkipped(f"the configuration has no {key}")
            opened: Any = None
            for attempt in range(_ATTEMPTS):
                try:
                    if opened is None:
                        opened = self._opened(key, kind, section)
                    self._start(kind, opened)
                    self._open[key] = opened
                    break
                except DeviceError as error:
                    if attempt + 1 == _ATTEMPTS:
                        cure = "check power and wiring; repeat the step"
                        finding = Finding(key, "refused", error.message, cure)
                        raise StepSkipped(f"{key} could not be opened", finding) from error
        return self._open[key]

    def section(self, key: str) -> tuple[str, Any]:
        """Return the kind of a device and its section, which is None if the device is not configured."""
        if key.startswith("wide_cameras"):
            return "camera", self.config.wide_cameras[int(key[13:-1])]
        if key.startswith("power."):
            power = self.config.power
            return "power_monitor", None if power is None else power.monitors().get(key)
        return key, getattr(self.config, key)

    def _opened(self, key: str, kind: str, section: Any) -> Any:
        if kind == "camera":
            if self.rig.cameras is not None:
                return self.rig.cameras[0 if key == kind else 1 + int(key[13:-1])]
            return open_camera(section, self.rig, self.stack)
        device = driver_of(kind, section, f"{key}.driver").open(self.rig, section)
        self.stack.callback(device.close)
        return device

    def _start(self, kind: str, device: Any) -> None:
        """Configure an open device. If this raises DeviceError, the same device can be started again."""
        if kind == "coils":
            cast(TorqueCoils, device).start()
        if kind == "inertial_unit":
            cast(InertialUnit, device).configure()
            self.wait(STILL_S)
            device.poll()

    def beat(self) -> None:
        """Send a heartbeat to the guardian, so that it permits currents, and replace a guardian that died."""
        if self.guardian is not None:
            with self._guarding:
                self.guardian.beat()
                self._lost += self.guardian.tend(self.rig.clock.now_ns()).count(GuardianNews.LOST)

    def lost_guardians(self) -> list[Finding]:
        """Return a finding if a guardian has died since the last call."""
        lost, self._lost = self._lost, 0
        text = f"the guardian of the coils died and was replaced, {lost} times"
        cure = "repeat the step, and look into the kernel log: was the memory exhausted?"
        return [Finding("guardian", "died", text, cure)] if lost else []

    def hold_brake(self) -> None:
        """Send heartbeats until the session ends, because a guardian without heartbeats releases brakes."""
        if self.guardian is not None:
            self.stack.callback(self.rig.clock.ticker("heartbeats", _POLL_NS, self.beat).stop)

    def wait(self, seconds: float, each: Callable[[], None] | None = None) -> None:
        """Wait for `seconds` s, and call `each` every 25 ms."""
        until_ns = self.rig.clock.now_ns() + round(seconds * SECOND_NS)
        while (now_ns := self.rig.clock.now_ns()) < until_ns:
            if each is not None:
                each()
            self.rig.clock.sleep_until_ns(min(until_ns, now_ns + _POLL_NS))

    def record(self, seconds: float, each: Callable[[], None] | None = None) -> Samples:
        """Return the readings of the inertial unit during `seconds` s, while `each` is called every 25 ms."""
        unit: InertialUnit = self.device("inertial_unit")
        unit.poll()
        before = unit.link()
        readings: list[ImuReading] = []

        def look() -> None:
            if each is not None:
                each()
            readings.extend(unit.poll())

        self.wait(seconds, look)
        readings += unit.poll()
        link = unit.link()
        if (rejected := link.out_of_range - before.out_of_range) > max(3, len(readings)):
            text = f"{rejected} samples are rejected: {link.rejection}"
            cure = "check the unit of its driver (deg/s or rad/s), and its range"
            kind = "stuck" if "identical" in link.rejection else "impossible values"
            finding = Finding("inertial_unit", kind, text, cure)
            raise StepSkipped("the inertial unit measures impossible values", finding)
        if len(readings) < 3:
            packets = link.packets - before.packets
            text = f"{len(readings)} valid samples and {packets} packets in {seconds:g} s"
            cure = "switch it off and on, and check the cable"
            finding = Finding("inertial_unit", "no samples", text, cure)
            raise StepSkipped("the inertial unit sends too few samples", finding)
        columns = [
            np.array([getattr(reading, name) for reading in readings], dtype=float).reshape(-1, 3)
            for name in ("rate", "field", "acceleration")
        ]
        return Samples(np.array([reading.time_ns for reading in readings]) * 1e-9, *columns)

    def frames(self, count: int, findings: list[Finding], key: str = "camera") -> list[Frame]:
        """Return `count` frames of a camera, and report triggers without a frame and late frames.

        Raises StepSkipped if no frame arrives at all.
        """
        source: FrameSource = self.device(key)
        exposure = self.section(key)[1].exposure
        taken: list[Frame] = []
        failed: list[str] = []
        for _ in range(count + _LOST_FRAMES):
            try:
                taken.append(self._frame(source, exposure))
            except DeviceError as error:
                failed.append(error.message)
            if len(taken) == count or (len(failed) > 1 and not taken):
                break
        if not taken:
            finding = Finding(key, "no frame", failed[0], "check its cable, power and trigger")
            raise StepSkipped(f"{key} delivers no frame", finding)
        late = max((one.arrival_ns - one.exposure_start_ns - one.exposure_ns) * 1e-9 for one in taken)
        if failed:
            text = f"{len(failed)} of {len(failed) + len(taken)} triggers give no frame ({failed[0]})"
            cure = "check plug, cable and supply for loose contact"
            findings.append(Finding(key, "intermittent", text, cure))
        elif late > _LATE_FRAME_S:
            text = f"a frame arrives {late:.1f} s after its exposure"
            cure = "check the load of its bus and of the processor"
            findings.append(Finding(key, "late", text, cure))
        return taken

    def _frame(self, source: FrameSource, exposure: float) -> Frame:
        """Trigger a camera, and return its frame. Raises DeviceError if no frame arrives.

        If the previous trigger closed the camera, its service reopens it within `_REOPENING_NS`.
        """
        clock = self.rig.clock
        until_ns = clock.now_ns() + _REOPENING_NS
        while True:
            try:
                source.trigger(round(exposure * SECOND_NS))
                break
            except (NotResponding, Refused):
                if clock.now_ns() > until_ns:
                    raise
                clock.sleep_until_ns(clock.now_ns() + _POLL_NS)
        until_ns = clock.now_ns() + _FRAME_PATIENCE_NS
        while (frame := source.poll()) is None:
            if clock.now_ns() > until_ns:
                raise NotResponding("camera", "no frame arrives within 12 s of the trigger")
            clock.sleep_until_ns(clock.now_ns() + _POLL_NS)
        return frame

    def close(self) -> None:
        """Set the coils to zero and close all devices."""
        if "coils" in self._open:
            self._open["coils"].off()
        self.stack.close()


# Search for devices, and for the reason why a device is missing.

_PCA9685 = [0xE2, 0xE4, 0xE8, 0xE0]
"""Registers 2 to 5 (SUBADR1 to ALLCALLADR) of a PCA9685, which our drivers leave at their power-on values."""
_INA219 = {0x399F, *(config_for(bits) & ~bus for bits in range(4) for bus in (0, BUS_32_V))}
"""Values of an INA219's configuration register after power-on (0x399F), and as set by our driver. Earlier
versions of our driver set the range of the bus voltage to 16 V."""
_ADDRESSES = [address for address in range(0x08, 0x78) if address != 0x70]
"""7-bit addresses without the reserved ones and without 0x70, to which every PCA9685 answers."""
_SERIAL = {"vn100": "VN-100", "gps": "GPS receiver"}
_LISTEN_NS = 1_200_000_000
_LOOK_NS = 20_000_000
_REGULAR, _PAUSE = 8, 5.0
"""Limits that a loose contact exceeds: number of pauses between data, ratio of longest to median pause."""


@dataclass(frozen=True, slots=True)
class Found:
    """The answer of a device, or the finding about its absence."""

    part: str
    place: str
    answer: str
    finding: Finding | None = None


def chip_at(bus: I2cBus, address: int) -> str | None:
    """Return the kind of the chip at an I2C address, "" for an unknown chip, or None without an answer."""
    try:
        if [bus.read_byte_data(address, register) for register in range(2, 6)] == _PCA9685:
            return "pca9685"
        high, low = bus.read_i2c_block_data(address, 0x00, 2)
    except OSError:
        return None
    return "ina219" if high << 8 | low in _INA219 else ""


def talker(
    rig: Rig, device: str, rates: tuple[int, ...], period_ns: int = _LISTEN_NS
) -> tuple[str, int, float]:
    """Return the kind of the device that sends on a serial line, its baud rate, and its longest pause, s.

    The kind is `vn100` or `gps`, or "" if none is recognised. The pause is 0 for a device that sends
    regularly. The baud rates `rates` are tried first, and then all baud rates of a VN-100. The first rate is
    tried for at least `period_ns`, because the last flight may have set this interval between messages.
    """
    listened_ns = max(_LISTEN_NS, period_ns)
    for rate in dict.fromkeys((*rates, *BAUD_RATES)):
        try:
            port = rig.wires.serial(device, rate)
            port.set_baud_rate(rate)
            port.receive()
            until_ns, parser, data = rig.clock.now_ns() + listened_ns, StreamParser(), b""
            listened_ns = _LISTEN_NS
            arrivals: list[int] = []
            while rig.clock.now_ns() < until_ns:
                rig.clock.sleep_until_ns(rig.clock.now_ns() + _LOOK_NS)
                for arrival_ns, chunk in port.receive():
                    if parser.feed(arrival_ns, chunk):  # one packet may arrive in several chunks
                        arrivals.append(arrival_ns)
                    data += chunk
        except DeviceError:
            continue
        if b"$VN" in data or parser.packets + parser.foreign > 2:
            pauses = np.diff(arrivals) * 1e-9
            irregular = len(pauses) > _REGULAR and pauses.max() > _PAUSE * np.median(pauses)
            return "vn100", rate, float(pauses.max()) if irregular else 0.0
        if b"\xb5\x62\x01" in data or b"$GN" in data or b"$GP" in data:
            return "gps", rate, 0.0
    return "", 0, 0.0


def find(config: Config, rig: Rig) -> Iterator[Found]:
    """Yield the answer of each configured device, or a finding with its remedy."""
    serial = {
        kind: one for kind in ("inertial_unit", "gps") if hasattr(one := getattr(config, kind), "device")
    }
    cameras: list[tuple[str, Any]] = [("camera", config.camera)] if config.camera is not None else []
    cameras += [(f"wide_cameras[{number}]", one) for number, one in enumerate(config.wide_cameras)]
    sections = fitted_devices(config) + [(key, "camera", section) for key, section in cameras]
    taken = {getattr(section, "address", None) for _, _, section in sections}
    for key, kind, section in sections:
        camera = kind == "camera"
        wired = section.device if camera else section  # an emulated camera needs no `device`
        driver = None if wired is None else driver_of(kind, wired)
        place = _place(config, key, section, driver)
        try:
            if camera and rig.cameras is None:
                with ExitStack() as opened:  # the camera is closed for later steps
                    open_camera(section, rig, opened)
            answer = "opens" if driver is None or camera else driver.probe(rig, section)
            finding = _wrong_part(key, section, rig, serial)
        except DeviceError as error:
            answer, finding = "", _missing(key, section, rig, serial, taken, error)
        yield Found(key, place, answer, finding)


def _place(config: Config, kind: str, section: Any, driver: Any) -> str:
    """Return the device file of a section and, for a chip, its I2C address."""
    files = () if driver is None else driver.files(section)
    bus = driver_of("coils", config.coils).files(config.coils)
    address = getattr(section, "address", None)
    if "camera" in kind and driver is None:
        return "emulated optics"
    return ", ".join([*(files or bus), *([] if address is None else [f"0x{address:02x}"])])


def _wrong_part(kind: str, section: Any, rig: Rig, serial: dict[str, Any]) -> Finding | None:
    """Return a finding if a different kind of device answers at the address of a section, else None."""
    named = getattr(section, "driver", "")
    if named in {"pca9685", "ina219"}:
        chip = chip_at(rig.wires.i2c(section.bus), section.address)
        if chip != named and chip:
            text = f"a chip of type {chip} answers at 0x{section.address:02x}"
            return Finding(kind, "exchanged", text, f"swap the addresses: a {named} is expected here")
    if kind == "gps":
        return _serial_finding(kind, section, rig, serial)
    return None


def _missing(
    kind: str, section: Any, rig: Rig, serial: dict[str, Any], taken: set[Any], error: DeviceError
) -> Finding:
    finding = None
    with suppress(DeviceError):  # `error` already states that the bus or serial line is missing
        if kind in serial:
            finding = _serial_finding(kind, section, rig, serial)
        elif getattr(section, "driver", "") in {"pca9685", "ina219"}:
            finding = _wrong_address(kind, section, rig, taken)
    problem, _, cure = error.message.partition(": ")
    return finding or Finding(kind, "no answer", problem, cure or "check power, cable and address")


def _wrong_address(kind: str, section: Any, rig: Rig, taken: set[Any]) -> Finding | None:
    """Search for a missing chip at all addresses of its bus that no section names."""
    bus, named = rig.wires.i2c(section.bus), section.driver
    chips = {address: chip for address in _ADDRESSES if (chip := chip_at(bus, address)) is not None}
    where = [address for address, chip in chips.items() if chip == named and address not in taken]
    if where:
        text = f"no answer at 0x{section.address:02x}, but a chip of type {named} answers at 0x{where[0]:02x}"
        cure = f"set `address: 0x{where[0]:02x}`, or change its jumpers"
        return Finding(kind, "wrong address", text, cure, setting=("address", where[0]))
    listed = ", ".join(f"0x{address:02x}" for address in chips) or "no address"
    text = f"no answer at 0x{section.address:02x}; addresses that answer on its bus: {listed}"
    return Finding(kind, "no answer", text, "check power, SDA, SCL and the address jumpers")


def _serial_finding(kind: str, section: Any, rig: Rig, serial: dict[str, Any]) -> Finding | None:
    """Return the fault that the data on a device's serial line show, or None if they show no fault."""
    wanted = "vn100" if kind == "inertial_unit" else "gps"
    if wanted == "vn100" and section.driver != "vn100":
        return None
    rates = tuple(dict.fromkeys([section.baud_rate, *(one.baud_rate for one in serial.values())]))
    period_ns = round((section.period + 0.2) * SECOND_NS) if wanted == "gps" else _LISTEN_NS
    what, rate, pause = talker(rig, section.device, rates, period_ns)
    rig.wires.serial(section.device, section.baud_rate).set_baud_rate(section.baud_rate)
    found = None
    # The u-blox driver changes the baud rate of its receiver, so the factory setting is not a fault.
    changed = wanted == "gps" and section.driver == "ublox" and rate in GPS_BAUD_RATES
    if what == wanted and rate != section.baud_rate and not changed:
        text = f"it sends at {rate} baud, not at {section.baud_rate}"
        cure = f"set `baud_rate: {rate}`, or change that of the device"
        found = Finding(kind, "wrong baud rate", text, cure, setting=("baud_rate", rate))
    elif what == wanted == "vn100" and pause:
        text = f"its output arrives on {section.device}, but stops for up to {pause:.2f} s"
        cure = "check plugs and solder joints for loose contact, and its supply"
        found = Finding(kind, "intermittent", text, cure)
    elif what == wanted == "vn100":
        text = f"its output arrives on {section.device}, but it does not answer"
        found = Finding(kind, "no answer", text, "check the wire from the host's TX to the unit's RX")
    elif what and what != wanted:
        text = f"{section.device} is the line of the {_SERIAL[what]}"
        cure = "swap the plugs, or the `device` of inertial_unit and gps"
        found = Finding(kind, "exchanged", text, cure)
    elif wanted == "gps" and not what:
        text = f"no message of a GPS receiver arrives on {section.device} at any baud rate"
        found = Finding(kind, "no answer", text, "check power, ground and the wire to the host's RX")
    return found
