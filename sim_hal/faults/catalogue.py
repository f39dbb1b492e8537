"""Simulated hardware that faults affect, and the table of all faults with their parameters and effects.

A bit flip that radiation causes in a register is called an upset. The driver must detect and repair an upset.
"""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import partial, reduce
from typing import TYPE_CHECKING

import numpy as np

from hal.drivers.pca9685 import CHANNELS, LED0_ON_L, MODE1, MODE2, PRE_SCALE
from hal.interfaces.devices import COIL_NAMES
from knightcube.astro.quaternion import from_rotation_vector, multiply
from sim_hal.emulators.coil_circuit import CALIBRATION, CONFIG, CoilCondition
from sim_hal.emulators.serial_line import SOUND, EmulatedSerialLine, HostEnd, LineFaults, PtyLine, Wire
from sim_hal.emulators.vn100 import BAUD_RATES, FIELD_BITS, UnitError
from sim_hal.emulators.vn100_sensors import GAUSS_PER_TESLA, Vn100Sample

if TYPE_CHECKING:  # imported only for types, because the table of faults does not need the devices
    from sim_hal.assembly import Hardware
    from sim_hal.emulators.coil_circuit import EmulatedIna219
    from sim_hal.emulators.i2c_bus import I2cPart
    from sim_hal.emulators.pca9685 import EmulatedPca9685
    from sim_hal.emulators.power import EmulatedAds1115

Removal = Callable[[], None]
"""Function that ends a fault."""


def no_removal() -> None:
    """Do nothing; the fault's effect lasts until the flight software repairs it."""


def hold(part: object | None, attribute: str, value: object, sound: object) -> Removal:
    """Set an attribute of a device until the fault is removed; do nothing if the device is None."""
    if part is None:
        return no_removal
    setattr(part, attribute, value)

    def remove() -> None:
        if getattr(part, attribute) is value:
            setattr(part, attribute, sound)

    return remove


def all_of(removals: Sequence[Removal]) -> Removal:
    """Return one function that removes several faults."""

    def remove() -> None:
        for removal in removals:
            removal()

    return remove


@dataclass(slots=True)
class Bench:
    """Emulated devices and lines to which faults are applied; the flight software itself is not changed.

    Attributes:
        line: serial line of the inertial unit.
        now_ns: function that returns the simulation time, ns.
        generator: random generator of the faults.
        host: host end of a serial line in memory, or None for a pseudo-terminal.
        flight_process: process identifier of the flight process, or None in lock-step.
        gps_line: serial line of the GPS receiver, or None if there is no receiver.
    """

    hardware: Hardware
    line: EmulatedSerialLine | PtyLine
    now_ns: Callable[[], int]
    generator: np.random.Generator
    host: HostEnd | None = None
    flight_process: int | None = None
    gps_line: EmulatedSerialLine | PtyLine | None = None
    _on_wires: dict[int, list[LineFaults]] = field(default_factory=dict)

    def disturb(self, wire: Wire, faults: LineFaults) -> Removal:
        """Add faults to the present faults of a wire, and return a function that removes them."""
        present = self._on_wires.setdefault(id(wire), [])
        present.append(faults)
        wire.faults = reduce(_combined, present, SOUND)

        def remove() -> None:
            present.remove(faults)
            wire.faults = reduce(_combined, present, SOUND)

        return remove

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        """Run `action` after `seconds` s of simulated time."""
        self.hardware.faults.at(self.now_ns() + round(seconds * 1e9), action)

    def toggle(self, begin: Callable[[], Removal], period: float, share: float) -> Removal:
        """Apply a fault intermittently, during the fraction `share` of each period of `period` s."""
        removals: list[Removal] = []
        stopped = False

        def pause() -> None:
            if removals:
                removals.pop()()

        def resume() -> None:
            if stopped:
                return
            removals.append(begin())
            self.after(share * period, pause)
            self.after(period, resume)

        def remove() -> None:
            nonlocal stopped
            stopped = True
            pause()

        resume()
        return remove


def _combined(a: LineFaults, b: LineFaults) -> LineFaults:
    return replace(
        a,
        silent=a.silent or b.silent,
        garbage=a.garbage or b.garbage,
        cut_probability=max(a.cut_probability, b.cut_probability),
        flip_probability=max(a.flip_probability, b.flip_probability),
        delay_ns=max(a.delay_ns, b.delay_ns),
        thinned=max(a.thinned, b.thinned),
    )


Parameters = Mapping[str, float]
Begin = Callable[[Bench, "FaultKind", Parameters], Removal]
"""Function that applies a fault to the bench and returns a function that removes the fault."""


def intermittently(begin: Begin) -> Begin:
    """Return the intermittent form of a fault, with the parameters `period` (s) and `share` (fraction)."""

    def toggled(bench: Bench, fault: FaultKind, given: Parameters) -> Removal:
        return bench.toggle(lambda: begin(bench, fault, given), given["period"], given["share"])

    return toggled


class Where(Enum):
    """Kind of simulation in which a fault can occur."""

    BOTH = "in lock-step and in real time"
    REALTIME = "in real time only"
    COMMAND_LINE = "on the command line only"


@dataclass(frozen=True, slots=True)
class Parameter:
    """A numeric parameter of a kind of fault.

    Attributes:
        default: default value, or None for a parameter that is drawn at random by default.
        low, high: smallest and largest allowed value.
        unit: physical unit of the value, or an empty text for a number without unit.
        whole: whether the value must be an integer.
        choices: allowed values, or empty if all values between the bounds are allowed.
    """

    default: float | None
    low: float
    high: float
    unit: str = ""
    whole: bool = False
    choices: tuple[float, ...] = ()

    def accepts(self, value: float) -> bool:
        """Return whether a value of a fault parameter is allowed. NaN is never allowed."""
        if self.choices:
            return value in self.choices
        return self.low <= value <= self.high and not (self.whole and value % 1.0)

    def bounds(self) -> str:
        """Return a text that describes the allowed values."""
        unit = f" {self.unit}" if self.unit else ""
        if not self.choices:
            return f"{'a whole number ' if self.whole else ''}from {self.low:g} to {self.high:g}{unit}"
        runs: list[list[float]] = []
        for value in self.choices:
            if runs and value == runs[-1][-1] + 1.0:
                runs[-1].append(value)
            else:
                runs.append([value])
        words = []
        for run in runs:  # three or more consecutive values are written as a range
            words += [f"{run[0]:g} to {run[-1]:g}"] if len(run) > 2 else [f"{value:g}" for value in run]
        return f"one of {', '.join(words)}{unit}"


@dataclass(frozen=True, slots=True)
class FaultKind:
    """Kind of fault, such as `imu: silent`.

    Attributes:
        device, kind: the two parts of the fault's name "device: kind".
        meaning: description of the fault's effect.
        begin: function that applies the fault to the bench and returns a function that removes it, or None
            for faults in the flight process.
        parameters: parameters of the fault by name.
        momentary: whether the fault is an event without duration, such as a reset, whose effect lasts until
            the flight software repairs it.
        where: kind of simulation in which the fault can occur.
        adds: whether the fault may be present together with other faults of the same device.
    """

    device: str
    kind: str
    meaning: str
    begin: Begin | None
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    momentary: bool = False
    where: Where = Where.BOTH
    adds: bool = False

    @property
    def name(self) -> str:
        """Name of the fault as users write it, "device: kind"."""
        return f"{self.device}: {self.kind}"

    @property
    def part(self) -> str:
        """Name of the affected part.

        A coil and its bridge count as one part, and so do the inertial unit and its magnetometer.
        """
        return self.device.replace("bridge-", "coil-").replace("magnetometer", "imu")


def _fault(
    name: str,
    meaning: str,
    begin: Begin | None,
    parameters: Mapping[str, Parameter] | None = None,
    *,
    momentary: bool = False,
    adds: bool = False,
    where: Where = Where.BOTH,
) -> FaultKind:
    device, _, kind = name.partition(": ")
    return FaultKind(device, kind, meaning, begin, parameters or {}, momentary, where, adds)


def _chance(default: float) -> Parameter:
    # The minimum is above 0, because a fault with the probability 0 would have no effect.
    return Parameter(default, 1e-6, 1.0)


def _delay(default: float) -> Parameter:
    return Parameter(default, 1e-3, 60.0, "s")


def _count(default: float, low: float, high: float) -> Parameter:
    return Parameter(default, low, high, whole=True)


def _gain(default: float) -> Parameter:
    return Parameter(default, 0.0, 10.0)


def _turns(period: float = 0.5) -> dict[str, Parameter]:
    """Return the parameters of an intermittent fault: period, and fraction of the period with the fault."""
    return {"period": Parameter(period, 0.05, 3600.0, "s"), "share": Parameter(0.5, 0.01, 0.99)}


def _nanoseconds(given: Parameters) -> int:
    return round(given["delay"] * 1e9)


_PARTS: dict[str, Callable[[Hardware], Sequence[object]]] = {
    "monitor": lambda hardware: (hardware.monitor,),
    "camera": lambda hardware: (hardware.camera,),
    "gps": lambda hardware: (hardware.orbit.gps,),
    "strings": lambda hardware: (hardware.orbit.cells,),
    "wide": lambda hardware: hardware.orbit.wide,
    "battery": lambda hardware: (hardware.power,),
    "panels": lambda hardware: (hardware.power,),
    "battery-monitor": lambda hardware: (hardware.power and hardware.power.rails[0],),
    "bus-monitor": lambda hardware: (hardware.power and hardware.power.rails[1],),
}
"""Emulated parts on which a device's faults set an attribute, or None for a part that is not configured."""


def _held(attribute: str, value: Callable[[FaultKind, Parameters], object], sound: object) -> Begin:
    """Return the `begin` of a fault that sets an attribute of a device to `value` until it is removed.

    The parameter `camera` of a fault selects one of the horizon cameras.
    """

    def begin(bench: Bench, fault: FaultKind, given: Parameters) -> Removal:
        number, parts = round(given.get("camera", 0.0)), _PARTS[fault.device](bench.hardware)
        chosen = [part for index, part in enumerate(parts, start=1) if number in {0, index}]
        held = value(fault, given)
        return all_of([hold(part, attribute, held, sound) for part in chosen])

    return begin


_frozen = _held("frozen", lambda *_: True, False)
_multiplied = _held("gain", lambda _, given: given["gain"], 1.0)
_shown = _held("fault", lambda fault, _: "off" if fault.kind == "intermittent" else fault.kind, "")
_old_conversions = _held("lag_ns", lambda _, given: _nanoseconds(given), 0)
_wrong_time = _held("clock_ns", lambda _, given: round(given["seconds"] * 1e9), 0)
_late = _held("late_ns", lambda _, given: _nanoseconds(given), 0)
_thinned = _held("one_of", lambda _, given: round(given["n"]), 1)


# Faults of the serial lines of inertial unit and GPS receiver.

_LINE_FAULTS: dict[str, Callable[[Parameters], LineFaults]] = {
    "silent": lambda _: LineFaults(silent=True),
    "garbage": lambda _: LineFaults(garbage=True),
    "slow": lambda given: LineFaults(thinned=round(given["n"])),
    "delayed": lambda given: LineFaults(delay_ns=_nanoseconds(given)),
    "intermittent": lambda _: LineFaults(silent=True),
    "bits": lambda given: LineFaults(flip_probability=given["chance"]),
    "cut": lambda given: LineFaults(cut_probability=given["chance"]),
}


def _on_line(bench: Bench, fault: FaultKind, given: Parameters) -> Removal:
    line = bench.line if fault.device == "imu" else bench.gps_line
    return no_removal if line is None else bench.disturb(line.to_host, _LINE_FAULTS[fault.kind](given))


# Faults of the inertial unit and its magnetometer.


def _without_power(bench: Bench, fault: FaultKind, _: Parameters) -> Removal:
    device = bench.hardware.unit if fault.device == "imu" else bench.hardware.orbit.gps
    if device is None:
        return no_removal
    device.switch_off()
    return lambda: device.switch_on(bench.now_ns())


def _unit_reset(bench: Bench, *_: object) -> Removal:
    bench.hardware.unit.switch_on(bench.now_ns())
    return no_removal


def _unplugged(bench: Bench, *_: object) -> Removal:
    if bench.host is not None:
        return hold(bench.host, "unplugged", True, False)
    # A pseudo-terminal cannot be unplugged, so both directions are silenced instead.
    wires = (bench.line.to_host, bench.line.to_device)
    return all_of([bench.disturb(wire, LineFaults(silent=True)) for wire in wires])


def _baud(bench: Bench, _: FaultKind, given: Parameters) -> Removal:
    # The emulated write is not checked, so the baud rate changes even if the line is then too slow.
    with suppress(UnitError):
        bench.hardware.unit.change_baud_rate(round(given["rate"]), bench.now_ns())
    return no_removal


def _stuck_samples(bench: Bench, fault: FaultKind, _: Parameters) -> Removal:
    """Repeat the first sample after the start of the fault, or only the magnetic field of this sample."""
    first: list[Vn100Sample] = []

    def alter(sample: Vn100Sample) -> Vn100Sample:
        if not first:
            first.append(sample)
        return first[0] if fault.device == "imu" else replace(sample, mag=first[0].mag)

    return hold(bench.hardware.unit, "alter", alter, None)


def _wrong_samples(bench: Bench, _: FaultKind, given: Parameters) -> Removal:
    turn = from_rotation_vector(np.array([0.0, given["angle"], 0.0]))
    bias = np.array([0.0, given["rate"], 0.0])

    def alter(sample: Vn100Sample) -> Vn100Sample:
        return replace(sample, quaternion=multiply(turn, sample.quaternion), rate=sample.rate + bias)

    return hold(bench.hardware.unit, "alter", alter, None)


def _dead_gyro(bench: Bench, *_: object) -> Removal:
    """Make the unit's rate NaN; its attitude, magnetic field and acceleration are not changed."""
    return hold(bench.hardware.unit, "alter", lambda sample: replace(sample, rate=np.full(3, math.nan)), None)


FULL_SCALE = 2.5
"""Full scale (gauss) of one magnetometer axis, from the VN-100 data sheet."""


def _saturated_field(bench: Bench, *_: object) -> Removal:
    def alter(sample: Vn100Sample) -> Vn100Sample:
        return replace(sample, mag=np.copysign(FULL_SCALE, sample.mag))

    return hold(bench.hardware.unit, "alter", alter, None)


def _false_field(bench: Bench, _: FaultKind, given: Parameters) -> Removal:
    direction = bench.generator.standard_normal(3)
    false = GAUSS_PER_TESLA * given["field"] * direction / np.linalg.norm(direction)
    return hold(bench.hardware.unit, "alter", lambda sample: replace(sample, mag=sample.mag + false), None)


# Faults of the I2C bus and the chips on the bus.


class AlteredPart:
    """A chip whose data are altered between chip and bus, while acknowledgements are not changed."""

    def __init__(
        self,
        part: I2cPart,
        write: Callable[[int, bytes], None] | None = None,
        read: Callable[[bytes], bytes] | None = None,
    ) -> None:
        """Use `write` instead of the chip's own method, and alter the data that the chip sends by `read`."""
        self._part = part
        self._write = write or part.write
        self._read = read or (lambda data: data)
        self.answers = part.answers

    def write(self, address: int, data: bytes) -> None:
        """Process a write. A single byte is a register pointer and is not altered."""
        (self._part.write if len(data) == 1 else self._write)(address, data)

    def read(self, count: int) -> bytes:
        """Return altered bytes."""
        return self._read(self._part.read(count))


def _parts(bench: Bench, device: str) -> Sequence[EmulatedPca9685 | EmulatedIna219 | EmulatedAds1115]:
    """Return the I2C chips of a device, or an empty tuple if the device is not configured."""
    hardware = bench.hardware
    if device == "strings":
        return () if hardware.orbit.cells is None else hardware.orbit.cells.parts
    if device == "monitor":
        return () if hardware.monitor is None else (hardware.monitor,)
    return (hardware.pwm,)


def _parts_off(bench: Bench, fault: FaultKind, _: Parameters) -> Removal:
    bus, parts = bench.hardware.bus, _parts(bench, fault.device)
    for part in parts:
        part.brown_out()
        bus.detach(part)
    return all_of([partial(bus.attach, part) for part in parts])


def _brown_out(bench: Bench, fault: FaultKind, _: Parameters) -> Removal:
    for part in _parts(bench, fault.device):
        part.brown_out()
    return no_removal


def _random_reads(bench: Bench, fault: FaultKind, _: Parameters) -> Removal:
    def read(data: bytes) -> bytes:
        return bench.generator.bytes(len(data))

    cover = bench.hardware.bus.put_before
    return all_of([cover(part, AlteredPart(part, read=read)) for part in _parts(bench, fault.device)])


def _flipped_bits(bench: Bench, fault: FaultKind, given: Parameters) -> Removal:
    def flipped(data: bytes) -> bytes:
        flips = np.packbits(bench.generator.random(8 * len(data)) < given["chance"])
        return (np.frombuffer(data, dtype=np.uint8) ^ flips).tobytes()

    def write(part: I2cPart, address: int, data: bytes) -> None:
        part.write(address, data[:1] + flipped(data[1:]))

    cover, parts = bench.hardware.bus.put_before, _parts(bench, fault.device)
    return all_of([cover(part, AlteredPart(part, partial(write, part), flipped)) for part in parts])


def _refused(bench: Bench, fault: FaultKind, _: Parameters) -> Removal:
    return all_of([bench.hardware.bus.nack(part.address, None) for part in _parts(bench, fault.device)])


def _stretched(bench: Bench, fault: FaultKind, given: Parameters) -> Removal:
    def chance() -> bool:
        return bench.generator.random() < given["chance"]

    return all_of([bench.hardware.bus.time_out(part.address, chance) for part in _parts(bench, fault.device)])


def _part_faults(device: str) -> tuple[FaultKind, ...]:
    """Return the faults that both the PWM chip and the current monitor can have."""
    low = "the chip stretches the clock beyond the bus timeout, with this probability"
    flips = "each bit read or written flips with this probability"
    lost = "the chip's registers return to their power-on values"
    off = "no power: the chip does not acknowledge and its registers are lost"
    refused = intermittently(_refused)
    return (
        _fault(f"{device}: off", off, _parts_off),
        _fault(f"{device}: nack", "it acknowledges nothing", _refused, adds=True),
        _fault(f"{device}: garbage", "reads return random bytes", _random_reads),
        _fault(f"{device}: bits", flips, _flipped_bits, {"chance": _chance(5e-3)}),
        _fault(f"{device}: slow", low, _stretched, {"chance": _chance(0.5)}, adds=True),
        _fault(f"{device}: intermittent", "it acknowledges intermittently", refused, _turns(), adds=True),
        _fault(f"{device}: brown-out", lost, _brown_out, momentary=True, adds=True),
    )


def _stuck_pwm(bench: Bench, *_: object) -> Removal:
    pwm = bench.hardware.pwm
    return bench.hardware.bus.put_before(pwm, AlteredPart(pwm, lambda address, data: None))


def _delayed_pwm(bench: Bench, _: FaultKind, given: Parameters) -> Removal:
    pwm = bench.hardware.pwm

    def later(address: int, data: bytes) -> None:
        bench.after(given["delay"], lambda: pwm.write(address, data))

    return bench.hardware.bus.put_before(pwm, AlteredPart(pwm, later))


def _wrong_frequency(bench: Bench, *_: object) -> Removal:
    bench.hardware.pwm.upset(PRE_SCALE, 0x1E)
    return no_removal


def _stuck_monitor(bench: Bench, *_: object) -> Removal:
    monitor: EmulatedIna219 | None = bench.hardware.monitor
    if monitor is None:
        return no_removal
    monitor.frozen = {number: monitor.register(number) for number in range(6)}
    monitor.frozen[2] |= 0b10  # the conversion-ready flag stays set
    return monitor.frozen.clear


def _lossy_bus(bench: Bench, _: FaultKind, given: Parameters) -> Removal:
    return bench.hardware.bus.nack(
        None, times=None, chance=lambda: bench.generator.random() < given["chance"]
    )


def _hanging_bus(bench: Bench, *_: object) -> Removal:
    return bench.hardware.bus.hang(None)


# Upsets.

_SET_UP = (MODE1, MODE2, PRE_SCALE)
_OUTPUTS = tuple(range(LED0_ON_L, LED0_ON_L + 4 * CHANNELS))
_MONITOR = (CONFIG, CALIBRATION)
_UNIT = (6, 7, 75)
"""Registers that set the unit's outputs: sentence type, sentence rate, and binary packet."""
_MAX_FIELDS = 11
"""Number of fields of register 75: ports, divisor, groups, and one word for each of eight groups."""


def _given_or_drawn(bench: Bench, given: Parameters, name: str, values: Sequence[int]) -> int:
    return round(given[name]) if name in given else int(bench.generator.choice(values))


def _upset_pwm(bench: Bench, _: FaultKind, given: Parameters) -> Removal:
    # Half of the draws select a configuration register, which a uniform draw would rarely select.
    among = _SET_UP if bench.generator.random() < 0.5 else _OUTPUTS
    register = _given_or_drawn(bench, given, "register", among)
    bench.hardware.pwm.flip(register, _given_or_drawn(bench, given, "bit", range(8)))
    return no_removal


def _upset_monitor(bench: Bench, _: FaultKind, given: Parameters) -> Removal:
    monitor = bench.hardware.monitor
    if monitor is not None:
        register = _given_or_drawn(bench, given, "register", _MONITOR)
        monitor.upset(register, _given_or_drawn(bench, given, "bit", range(16)))
    return no_removal


def _upset_unit(bench: Bench, _: FaultKind, given: Parameters) -> Removal:
    unit = bench.hardware.unit
    register = _given_or_drawn(bench, given, "register", _UNIT)
    bits = FIELD_BITS * len(unit.registers.read(register))
    unit.upset(register, _given_or_drawn(bench, given, "bit", range(bits)), bench.now_ns())
    return no_removal


def _upset(name: str, begin: Begin, registers: tuple[int, ...], bits: int, meaning: str = "") -> FaultKind:
    register = Parameter(None, min(registers), max(registers), choices=tuple(sorted(registers)))
    given = {"register": register, "bit": Parameter(None, 0.0, bits - 1.0, whole=True)}
    return _fault(name, f"a bit of a register flips{meaning}", begin, given, momentary=True, adds=True)


# Faults of coils, cameras, GPS receiver, solar strings, and flight process.


def _coil(bench: Bench, fault: FaultKind, given: Parameters) -> Removal:
    circuit, axis = bench.hardware.circuit, COIL_NAMES.index(fault.device[-1])
    circuit.become(axis, CoilCondition(fault.kind), given.get("ohm", 0.0))
    return lambda: circuit.become(axis, CoilCondition.SOUND)


def _coil_faults(axis: str) -> tuple[FaultKind, ...]:
    """Return the faults of a coil and its bridge, where `axis` is the name of the coil."""
    ohm = Parameter(5.0, 0.1, 1000.0, "ohm")
    return (
        _fault(f"coil-{axis}: open", "broken wire: no current", _coil),
        _fault(
            f"coil-{axis}: shorted",
            "short circuit of resistance `ohm` across the bridge: no current in the coil",
            _coil,
            {"ohm": ohm},
        ),
        _fault(f"coil-{axis}: reversed", "reversed polarity", _coil),
        *(
            _fault(f"bridge-{axis}: {leg.lower()}-{level}", f"the output of input {leg} stays {level}", _coil)
            for leg in "AB"
            for level in ("high", "low")
        ),
    )


def _frame_faults(device: str, *without: str, **parameters: Parameter) -> tuple[FaultKind, ...]:
    """Return the faults of the star camera or of the horizon cameras; each fault accepts the `parameters`."""
    rows: tuple[tuple[str, str, Begin, dict[str, Parameter]], ...] = (
        ("off", "the camera ignores triggers and delivers no frame", _shown, {}),
        ("black", "frames without light", _shown, {}),
        ("saturated", "saturated frames", _shown, {}),
        ("blinded", "the Sun's stray light over the whole frame", _shown, {}),
        ("frozen", "the same frame repeatedly", _shown, {}),
        ("torn", "upper part of the previous frame, lower part of this one", _shown, {}),
        ("garbage", "random pixels", _shown, {}),
        ("wrong", "rows in reverse order", _shown, {}),
        ("slow", "only every n-th trigger gives a frame", _thinned, {"n": _count(3.0, 2.0, 1000.0)}),
        ("delayed", "frames arrive later, s", _late, {"delay": _delay(3.0)}),
        ("intermittent", "off intermittently", intermittently(_shown), _turns(6.0)),
    )
    return tuple(
        _fault(f"{device}: {kind}", meaning, begin, {**parameters, **more})
        for kind, meaning, begin, more in rows
        if kind not in without
    )


def _false_position(bench: Bench, _: FaultKind, given: Parameters) -> Removal:
    gps = bench.hardware.orbit.gps
    if gps is None:
        return no_removal
    direction = bench.generator.standard_normal(3)
    return hold(gps, "shift", given["distance"] * direction / np.linalg.norm(direction), np.zeros(3))


def _dead(bench: Bench, _: FaultKind, given: Parameters) -> Removal:
    cells = bench.hardware.orbit.cells
    if cells is None:
        return no_removal
    dead = np.zeros(len(cells.dead), dtype=bool)
    number = round(given["string"])
    dead[number - 1 if number else slice(None)] = True
    return hold(cells, "dead", dead, np.zeros(len(dead), dtype=bool))


def _monitor_off(bench: Bench, fault: FaultKind, _: Parameters) -> Removal:
    power = bench.hardware.power
    rail = None if power is None else power.rails[RAILS.index(fault.device)]
    if rail is None or rail.bus is None:
        return no_removal
    bus, monitor = rail.bus, rail.monitor
    monitor.brown_out()
    bus.detach(monitor)
    return partial(bus.attach, monitor)


def _killed(bench: Bench, *_: object) -> Removal:
    if bench.flight_process is not None:
        os.kill(bench.flight_process, signal.SIGKILL)
    return no_removal


def _stopped(bench: Bench, *_: object) -> Removal:
    process = bench.flight_process
    if process is None:
        return no_removal
    os.kill(process, signal.SIGSTOP)
    return lambda: os.kill(process, signal.SIGCONT)


def _worker_faults(device: str) -> tuple[FaultKind, ...]:
    return (
        _fault(f"{device}: nan", "all numbers of the worker's result are NaN", None),
        _fault(f"{device}: exception", "the worker raises an exception", None),
        _fault(f"{device}: endless", "the worker never returns", None),
        _fault(f"{device}: killed", "the worker's process is killed during a job", None),
        _fault(f"{device}: slow", "results arrive later, s", None, {"delay": _delay(1.5)}),
    )


RAILS = ("battery-monitor", "bus-monitor")
"""Monitors of the power system, in the order of `EmulatedPower.rails`."""
_EACH_BIT = "each bit flips with this probability"
_EACH_FIELD = f"; each of its fields has {FIELD_BITS} bits"
_LOW_AT_TIMES = "the clock line is held low intermittently"
_WRONG = {"angle": Parameter(0.2, -math.pi, math.pi, "rad"), "rate": Parameter(0.05, -10.0, 10.0, "rad/s")}
_RATE = Parameter(230400.0, min(BAUD_RATES), max(BAUD_RATES), "baud", choices=BAUD_RATES)
_FIELD = Parameter(2e-5, 1e-8, 1e-3, "T")
_DISTANCE = Parameter(2e4, 1.0, 2e7, "m")
_SECONDS = Parameter(180.0, -86_400.0, 86_400.0, "s")
_STEP = Parameter(3600.0, -3.2e8, 3.2e8, "s")

_ALL = (
    _fault("imu: off", "no power; restarts from its saved settings afterwards", _without_power),
    _fault("imu: silent", "no byte arrives", _on_line, adds=True),
    _fault("imu: unplugged", "the serial port disappears", _unplugged),
    _fault("imu: stuck", "valid packets, constant values", _stuck_samples),
    _fault("imu: gyro-dead", "valid packets, the rate is not a number", _dead_gyro),
    _fault("imu: garbage", "random bytes replace the bytes of the device", _on_line, adds=True),
    _fault("imu: wrong", "valid packets, wrong values", _wrong_samples, _WRONG),
    _fault("imu: slow", "one of n packets arrives", _on_line, {"n": _count(8.0, 2.0, 1000.0)}, adds=True),
    _fault("imu: delayed", "every byte arrives with a delay, s", _on_line, {"delay": _delay(0.2)}, adds=True),
    _fault("imu: intermittent", "silent intermittently", intermittently(_on_line), _turns(), adds=True),
    _fault("imu: bits", _EACH_BIT, _on_line, {"chance": _chance(1e-3)}, adds=True),
    _fault(
        "imu: cut", "packets lose bytes with this probability", _on_line, {"chance": _chance(0.3)}, adds=True
    ),
    _fault("imu: reset", "restarts from its saved settings", _unit_reset, momentary=True),
    _fault("imu: baud", "the unit's baud rate changes", _baud, {"rate": _RATE}, momentary=True),
    _upset("imu: upset", _upset_unit, _UNIT, FIELD_BITS * _MAX_FIELDS, _EACH_FIELD),
    _fault("magnetometer: stuck", "a constant field", _stuck_samples),
    _fault("magnetometer: saturated", "all axes at full scale", _saturated_field),
    _fault("magnetometer: false", "a constant field is added, T", _false_field, {"field": _FIELD}),
    *_part_faults("pwm"),
    _fault("pwm: stuck", "the chip acknowledges, but its outputs do not change", _stuck_pwm),
    _fault("pwm: delayed", "writes take effect after a delay, s", _delayed_pwm, {"delay": _delay(0.2)}),
    _fault(
        "pwm: wrong", "a register upset: wrong PWM frequency", _wrong_frequency, momentary=True, adds=True
    ),
    _upset("pwm: upset", _upset_pwm, (*_SET_UP, *_OUTPUTS), 8),
    *_part_faults("monitor"),
    _fault("monitor: stuck", "always the same conversion", _stuck_monitor),
    _fault(
        "monitor: delayed",
        "reads return measurements of this age, s",
        _old_conversions,
        {"delay": _delay(2.0)},
    ),
    _fault("monitor: wrong", "measured values are multiplied by gain", _multiplied, {"gain": _gain(2.0)}),
    _upset("monitor: upset", _upset_monitor, _MONITOR, 16),
    _fault(
        "bus: off", "no part acknowledges", lambda bench, *_: bench.hardware.bus.nack(None, None), adds=True
    ),
    _fault(
        "bus: nack", "no acknowledge, with this probability", _lossy_bus, {"chance": _chance(0.5)}, adds=True
    ),
    _fault(
        "bus: arbitration",
        "another master always wins",
        lambda bench, *_: bench.hardware.bus.lose_arbitration(None),
        adds=True,
    ),
    _fault("bus: hang", "the clock line is held low", _hanging_bus, adds=True),
    _fault("bus: intermittent", _LOW_AT_TIMES, intermittently(_hanging_bus), _turns(), adds=True),
    *(fault for axis in COIL_NAMES for fault in _coil_faults(axis)),
    *_frame_faults("camera"),
    _fault(
        "gps: off",
        "no power; then default settings and a new search for satellites",
        _without_power,
    ),
    _fault("gps: silent", "no byte arrives", _on_line, adds=True),
    _fault("gps: no-fix", "no satellite is received", _held("blind", lambda *_: True, False)),
    _fault("gps: stuck", "the same epoch repeatedly", _frozen),
    _fault("gps: false", "a valid fix with a wrong position, m", _false_position, {"distance": _DISTANCE}),
    _fault("gps: clock", "a valid fix with the wrong time, s", _wrong_time, {"seconds": _SECONDS}, adds=True),
    _fault("gps: garbage", "random bytes replace the bytes of the device", _on_line, adds=True),
    _fault("gps: bits", _EACH_BIT, _on_line, {"chance": _chance(1e-3)}, adds=True),
    _fault("gps: delayed", "every byte arrives with a delay, s", _on_line, {"delay": _delay(2.0)}, adds=True),
    _fault("gps: intermittent", "silent intermittently", intermittently(_on_line), _turns(), adds=True),
    _fault("strings: off", "no power: no converter acknowledges", _parts_off),
    _fault(
        "strings: dead",
        "a string gives no current",
        _dead,
        {"string": _count(1.0, 0.0, 4.0)},
    ),
    _fault("strings: stuck", "constant currents", _frozen),
    _fault("strings: wrong", "all currents are multiplied by gain", _multiplied, {"gain": _gain(0.5)}),
    _fault("strings: garbage", "reads return random bytes", _random_reads),
    # `camera` is the number of a camera in the order of the configuration; 0 means all.
    *_frame_faults("wide", "torn", "slow", camera=_count(0.0, 0.0, 6.0)),
    *(
        fault
        for device in RAILS
        for fault in (
            _fault(f"{device}: off", "no power: the chip does not acknowledge", _monitor_off),
            _fault(f"{device}: stuck", "always the same values", _held("stuck", lambda *_: True, False)),
            _fault(
                f"{device}: wrong",
                "measured values are multiplied by gain",
                _multiplied,
                {"gain": _gain(0.5)},
            ),
        )
    ),
    _fault("battery: cell-lost", "a cell gives no voltage", _held("cells_lost", lambda *_: 1, 0)),
    _fault(
        "battery: weak",
        "capacity divided by factor, resistance multiplied by it",
        _held("weakness", lambda _, given: given["factor"], 1.0),
        {"factor": Parameter(4.0, 1.0, 100.0)},
    ),
    _fault(
        "panels: lost",
        "a panel gives no power",
        _held("lost_panel", lambda _, given: round(given["panel"]), None),
        {"panel": _count(1.0, 0.0, 32.0)},
    ),
    *_worker_faults("planner"),
    *_worker_faults("vision"),
    _fault("process: killed", "kill -9 of the flight process", _killed, momentary=True, where=Where.REALTIME),
    _fault("process: stopped", "SIGSTOP of the flight process", _stopped, where=Where.REALTIME),
    _fault("clock: stepped", "the wall clock steps forward, s", None, {"by": _STEP}),
    _fault("disk: full", "the log cannot grow", None),
    _fault("disk: failing", "every write of the log fails", None),
    _fault(
        "config: corrupted",
        "one bit flips in each of `bytes` bytes of the file before it is read",
        None,
        {"bytes": _count(3.0, 1.0, 10000.0)},
        momentary=True,
        where=Where.COMMAND_LINE,
    ),
)

CATALOGUE: dict[str, FaultKind] = {kind.name: kind for kind in _ALL}


def listing() -> str:
    """Return a text that lists every fault with its parameters and meaning, one fault per line."""
    lines = []
    for kind in CATALOGUE.values():
        given = ", ".join(
            f"{name}={'random' if parameter.default is None else f'{parameter.default:g}'}"
            for name, parameter in kind.parameters.items()
        )
        name = f"{kind.name} ({given})" if given else kind.name
        only = "" if kind.where is Where.BOTH else f"; {kind.where.value}"
        bounds = "".join(f"; {name} {parameter.bounds()}" for name, parameter in kind.parameters.items())
        lines.append(f"  {name:50} {kind.meaning}{bounds}{only}")
    return "\n".join(lines)
