"""Search for the devices of a configuration, and for the reason why a device is missing.

A missing chip is searched for at all addresses of its bus, and a missing serial device on all serial lines of
the configuration at all baud rates. Chips are identified by registers that no driver changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from flight.app.devices import open_camera
from flight.schema.devices import driver_of, fitted_devices
from flight.schema.sections import Config
from ground.bringup.diagnosis import Finding
from hal.drivers.current_monitors import config_for
from hal.drivers.vn100 import BAUD_RATES
from hal.drivers.vn100_protocol import StreamParser
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import I2cBus, Rig

_PCA9685 = [0xE2, 0xE4, 0xE8, 0xE0]
"""Registers 2 to 5 (SUBADR1 to ALLCALLADR) of a PCA9685, which our drivers leave at their power-on values."""
_INA219 = {0x399F, *(config_for(bits) for bits in range(4))}
"""Values of an INA219's configuration register: after power-on (first), and as set by our driver."""
_ADDRESSES = [address for address in range(0x08, 0x78) if address != 0x70]
"""7-bit addresses without the reserved ones and without 0x70, to which every PCA9685 answers."""
_SERIAL = {"vn100": "VN-100", "gps": "GPS receiver"}
_LISTEN_NS = 1_200_000_000
_LOOK_NS = 20_000_000
_REGULAR, _PAUSE = 8, 5.0
"""Limits above which a contact is loose: number of pauses between data, ratio of longest to median pause."""


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


def talker(rig: Rig, device: str, rates: tuple[int, ...]) -> tuple[str, int, float]:
    """Return which kind of device sends on a serial line, its baud rate, and its longest pause, s.

    The kind is `vn100` or `gps`, or "" if none is recognised. The pause is 0 for a device that sends
    regularly. The `rates` are tried first, and then all rates of a VN-100.
    """
    for rate in dict.fromkeys((*rates, *BAUD_RATES)):
        try:
            port = rig.wires.serial(device, rate)
            port.set_baud_rate(rate)
            port.receive()
            until_ns, parser, data = rig.clock.now_ns() + _LISTEN_NS, StreamParser(), b""
            arrivals: list[int] = []
            while rig.clock.now_ns() < until_ns:
                rig.clock.sleep_until_ns(rig.clock.now_ns() + _LOOK_NS)
                for arrival_ns, chunk in port.receive():
                    parser.feed(arrival_ns, chunk)
                    arrivals.append(arrival_ns)
                    data += chunk
        except DeviceError:
            return "", 0, 0.0
        if b"$VN" in data or parser.packets + parser.foreign > 2:
            pauses = np.diff(arrivals) * 1e-9
            irregular = len(pauses) > _REGULAR and pauses.max() > _PAUSE * np.median(pauses)
            return "vn100", rate, float(pauses.max()) if irregular else 0.0
        if b"\xb5\x62\x01" in data or b"$GN" in data or b"$GP" in data:
            return "gps", rate, 0.0
    return "", 0, 0.0


def find(config: Config, rig: Rig, stack: Any) -> Iterator[Found]:
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
                open_camera(section, rig, stack)
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
    """Return the finding about a device that does not answer."""
    finding = None
    with suppress(DeviceError):  # if the bus or the line itself is missing, `error` already states this
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
        return Finding(kind, "wrong address", text, f"set `address: 0x{where[0]:02x}`, or change its jumpers")
    listed = ", ".join(f"0x{address:02x}" for address in chips) or "no address"
    text = f"no answer at 0x{section.address:02x}; addresses that answer on its bus: {listed}"
    return Finding(kind, "no answer", text, "check power, SDA, SCL and the address jumpers")


def _serial_finding(kind: str, section: Any, rig: Rig, serial: dict[str, Any]) -> Finding | None:
    """Return why the device of a serial line is missing or sends nothing useful, or None if it is unknown."""
    wanted = "vn100" if kind == "inertial_unit" else "gps"
    if wanted == "vn100" and section.driver != "vn100":
        return None
    rates = tuple(dict.fromkeys([section.baud_rate, *(one.baud_rate for one in serial.values())]))
    what, rate, pause = talker(rig, section.device, rates)
    found = None
    if what == wanted and rate != section.baud_rate:
        text = f"it sends at {rate} baud, not at {section.baud_rate}"
        found = Finding(
            kind, "wrong baud rate", text, f"set `baud_rate: {rate}`, or change that of the device"
        )
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
