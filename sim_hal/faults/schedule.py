"""Syntax of faults, and functions that check and schedule the faults of a flight.

A fault is written `DEVICE: KIND [(NAME=VALUE, ...)] [@ SECONDS] [for SECONDS]`. The value after `@` is the
mission time of the beginning (s), and the value after `for` the duration (s). A fault without `@` begins at
mission time 0, and a fault without `for` lasts until the end of the flight. In the `simulation` section of a
configuration the same fault is written `{fault: 'imu: silent', at: 120, for: 5}`.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

from flight.schema.sections import Config
from hal.interfaces.devices import COIL_NAMES
from knightcube.errors import UsageError
from sim_hal.faults.catalogue import CATALOGUE, RAILS, Bench, FaultKind, Removal, Where
from sim_hal.settings import FaultEntry

GRAMMAR = "DEVICE: KIND [(NAME=VALUE, ...)] [@ SECONDS] [for SECONDS]"

LONGEST = 1e9
"""Latest start and longest duration (s) of a fault: thirty years, so that times in ns fit into 64 bits."""

_FAULT = re.compile(
    r"\s*(?P<name>[\w-]+\s*:\s*[\w-]+)\s*(\((?P<given>[^()]*)\))?"
    r"\s*(@\s*(?P<at>\S+))?\s*(\bfor\s+(?P<span>\S+))?\s*"
)


@dataclass(frozen=True, slots=True)
class ScheduledFault:
    """A fault that begins at mission time `at` (s) and lasts `span` s, or to the end if `span` is None."""

    kind: FaultKind
    at: float
    span: float | None
    parameters: Mapping[str, float]

    @property
    def end(self) -> float:
        """Mission time (s) of the fault's end, which is infinite for a fault without a duration."""
        if self.kind.momentary:
            return self.at
        return math.inf if self.span is None else self.at + self.span

    def __str__(self) -> str:
        """Return the fault as text in the form that users write."""
        given = ", ".join(f"{name}={value:g}" for name, value in self.parameters.items())
        lasts = "" if self.span is None else f" for {self.span:g}"
        return f"{self.kind.name}{f' ({given})' if given else ''} @ {self.at:g}{lasts}"


def parse(text: str) -> ScheduledFault:
    """Parse one fault. Raises UsageError that states the correct form."""
    found = _FAULT.fullmatch(text)
    if found is None:
        raise UsageError(f"fault {text!r}: write it as {GRAMMAR}")
    device, _, kind = (part.strip() for part in found["name"].lower().partition(":"))
    known = CATALOGUE.get(f"{device}: {kind}")
    if known is None:
        name = ": ".join(part.strip() for part in found["name"].split(":"))
        same = [other for other in CATALOGUE if other.startswith(f"{device}:")]
        near = difflib.get_close_matches(name.lower(), same or list(CATALOGUE), n=1, cutoff=0.0)
        rest = f" ({device} has {', '.join(other.partition(': ')[2] for other in same)})" if same else ""
        raise UsageError(f"fault {text!r}: {name!r} is an unknown fault, did you mean {near[0]!r}?{rest}")
    at = _seconds(found["at"], "@", text) if found["at"] is not None else 0.0
    span = _seconds(found["span"], "for", text) if found["span"] is not None else None
    if span == 0.0:
        raise UsageError(
            f"fault {text!r}: `for 0` is an empty duration: give a longer duration, or omit `for`"
        )
    values = {name: value.default for name, value in known.parameters.items() if value.default is not None}
    for word in filter(None, (word.strip() for word in (found["given"] or "").split(","))):
        name, equals, value = (part.strip() for part in word.partition("="))
        if name not in known.parameters or not equals:
            taken = ", ".join(f"{one}=VALUE" for one in known.parameters) or "no parameters"
            raise UsageError(f"fault {text!r}: {word!r}: `{known.name}` takes {taken}")
        values[name] = _number(value, name, text)
        if not known.parameters[name].accepts(values[name]):
            bounds = known.parameters[name].bounds()
            raise UsageError(f"fault {text!r}: {name}={value}: the value must be {bounds}")
    return ScheduledFault(known, at, span, values)


def _seconds(word: str, after: str, text: str) -> float:
    value = _number(word, after, text)
    if value < 0.0:
        raise UsageError(f"fault {text!r}: {after} {word}: seconds cannot be below zero")
    if value > LONGEST:
        raise UsageError(f"fault {text!r}: {after} {word}: give at most {LONGEST:g} s")
    return value


def _number(word: str, what: str, text: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"fault {text!r}: {what} {word!r} is not a number")
    return value


def schedule(entries: Sequence[FaultEntry]) -> tuple[ScheduledFault, ...]:
    """Parse the faults of a `simulation` section.

    Raises UsageError, with the entry in the message, for an invalid entry.
    """
    read = []
    for number, entry in enumerate(entries):
        key = f"simulation.faults[{number}]"
        try:
            fault = parse(entry.fault)
        except UsageError as error:
            raise UsageError(f"{key}: {error}") from error
        if entry.at is not None and "@" in entry.fault:
            raise UsageError(f"{key}: both `at` and `@` give the start time: remove one")
        if entry.span is not None and fault.span is not None:
            raise UsageError(f"{key}: `for` is given twice: remove one")
        at = fault.at if entry.at is None else entry.at
        span = fault.span if entry.span is None else entry.span
        if max(at, span or 0.0) > LONGEST:
            raise UsageError(f"{key}: give at most {LONGEST:g} s")
        read.append(replace(fault, at=at, span=span))
    return tuple(read)


def entries(texts: Sequence[str]) -> tuple[FaultEntry, ...]:
    """Return the faults from the command line as entries of a `simulation` section.

    Faults that only the command line can inject are omitted, because they have already been applied to the
    configuration's text. Raises UsageError for an invalid fault.
    """
    faults = map(parse, texts)
    return tuple(
        FaultEntry(fault=str(fault)) for fault in faults if fault.kind.where is not Where.COMMAND_LINE
    )


def scheduled(entries: Sequence[FaultEntry], realtime: bool) -> tuple[ScheduledFault, ...]:
    """Parse the faults of a section for lock-step or real time. Raises UsageError for an impossible fault."""
    faults = schedule(entries)
    for fault in faults:
        if fault.kind.where is Where.REALTIME and not realtime:
            raise UsageError(f"fault {str(fault)!r}: it exists in real time only: add --realtime")
        if fault.kind.where is Where.COMMAND_LINE:
            raise UsageError(
                f"fault {str(fault)!r}: give it with --fault, because it corrupts the configuration file"
            )
    alone = [fault for fault in faults if not fault.kind.adds]
    for number, fault in enumerate(alone):
        for other in alone[:number]:
            first, second = sorted((fault, other), key=lambda one: one.at)
            meet = second.at < first.end or second.at == first.at
            if fault.kind.part == other.kind.part and meet:
                raise UsageError(
                    f"fault {str(fault)!r} would replace {str(other)!r}: "
                    "let one end (`for`) before the other begins"
                )
    return faults


_SECTIONS = {
    "camera": "camera",
    "vision": "camera",
    "monitor": "power_monitor",
    "gps": "gps",
    "strings": "solar_strings",
    "wide": "wide_cameras",
    **dict.fromkeys(("battery", "battery-monitor", "bus-monitor", "panels"), "power"),
}
"""Configuration section of each optional device."""
_EMULATED = {
    "imu": ("inertial_unit", "vn100"),
    "magnetometer": ("inertial_unit", "vn100"),
    "monitor": ("power_monitor", "ina219"),
    "gps": ("gps", "ublox"),
    "strings": ("solar_strings", "ads1115"),
    **dict.fromkeys(("coil", "bridge", "pwm"), ("coils", "pca9685")),
}
"""Configuration section and driver that the faults of a device need, by first word of the device name."""


def _rail_key(device: str) -> str:
    """Return the dotted key of a monitor of the power system."""
    return f"power.{device.replace('-', '_')}"


def other_driver(device: str, config: Config) -> str:
    """Return the reason why a fault cannot act on a device with its driver, or an empty text if it can."""
    kind, driver = _EMULATED.get(device.partition("-")[0], ("", ""))
    section = getattr(config, kind, None)
    if device in RAILS and config.power is not None:
        kind, driver = _rail_key(device), "ina219"
        section = config.power.monitors().get(kind)
    if section is None or section.driver == driver:
        return ""
    return f"faults act on the emulated device of `{kind}.driver: {driver}`, not on {section.driver!r}"


def fitted(device: str, config: Config) -> bool:
    """Return whether a configuration contains the device of a fault."""
    if device == "planner":
        return config.replan_period() is not None
    if device.startswith(("coil-", "bridge-")):
        return COIL_NAMES.index(device[-1]) < len(config.coils.slots)
    if device in RAILS:
        return config.power is not None and _rail_key(device) in config.power.monitors()
    section = _SECTIONS.get(device)
    return section is None or getattr(config, section) not in (None, ())


def check(entries: Sequence[FaultEntry], config: Config, realtime: bool) -> tuple[ScheduledFault, ...]:
    """Parse and check the faults of a flight. Raises UsageError for a fault that would have no effect."""
    faults = scheduled(entries, realtime)
    for fault in faults:
        if fault.at >= config.duration:
            raise UsageError(
                f"fault {str(fault)!r}: the flight ends at {config.duration:g} s: "
                "begin it earlier, or fly longer (--duration)"
            )
        device = fault.kind.device
        if not fitted(device, config):
            section = _SECTIONS.get(device)
            if device in RAILS and config.power is not None:
                section = _rail_key(device)
            cure = f"the configuration needs a `{section}` section" if section else "the body plans no paths"
            if device.startswith(("coil-", "bridge-")):
                cure = f"the configuration has {len(config.coils.windings)} coils"
            raise UsageError(f"fault {str(fault)!r}: this flight has no {device}: {cure}")
        if problem := other_driver(device, config):
            raise UsageError(f"fault {str(fault)!r}: {problem}")
        if fault.kind.name == "imu: baud" and fault.parameters["rate"] == config.inertial_unit.baud_rate:
            raise UsageError(f"fault {str(fault)!r}: the unit has this rate already: give another rate")
    return faults


def put(faults: Sequence[ScheduledFault], bench: Bench, epoch_ns: int) -> None:
    """Schedule the beginning and end of each fault, relative to `epoch_ns`."""
    for fault in faults:
        if fault.kind.begin is None:
            continue
        removals: list[Removal] = []
        timeline, begin_ns = bench.hardware.faults, epoch_ns + round(fault.at * 1e9)
        timeline.at(begin_ns, partial(_begin, fault, bench, removals))
        if fault.span is not None and not fault.kind.momentary:
            timeline.at(begin_ns + round(fault.span * 1e9), partial(_end, removals))


def _begin(fault: ScheduledFault, bench: Bench, removals: list[Removal]) -> None:
    assert fault.kind.begin is not None  # faults without `begin` are not scheduled
    removals.append(fault.kind.begin(bench, fault.kind, fault.parameters))


def _end(removals: list[Removal]) -> None:
    removals.pop()()
