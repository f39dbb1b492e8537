"""The steps of a bench session with the devices of a satellite: power system, GPS receiver, solar strings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from flight.schema.devices import Power
from ground.bringup.bench import Outcome, Session, StepSkipped
from ground.bringup.diagnosis import Finding
from hal.interfaces.devices import GpsReading, GpsReceiver, PowerMonitor, PowerReading, SolarStrings
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray

_SETTLE_S = 1.6  # time (s) after a change of the current until a monitor's mean contains only the new current
_MONITOR_S = 1.0
_NEAR = 0.15  # largest relative difference between the changes of the current that two monitors measure


# Power system.


def step_power(session: Session) -> Outcome:
    """Read the monitors of battery and bus, with and without the current of a coil."""
    power = session.config.power
    if power is None:
        raise StepSkipped("the configuration has no section `power`")
    findings: list[Finding] = []
    monitors: dict[str, PowerMonitor] = {}
    for key in power.monitors():
        try:
            monitors[key] = session.device(key)
        except StepSkipped as reason:
            findings += [reason.finding] if reason.finding else []
    session.ask("Disconnect charger and solar panels. One coil is driven now.")
    coils = session.device("coils")
    section = session.config.coils
    command = np.zeros(len(section.slots))
    command[0] = min(section.limits[0], section.supply_voltage / section.resistance[0])
    rest = _readings(session, monitors, np.zeros_like(command))
    driven = _readings(session, monitors, command)
    coils.off()
    values: dict[str, dict[str, float]] = {}
    for key, monitor in monitors.items():
        before, after = rest[key], driven[key]
        if before is None or after is None:
            problem = monitor.error() or "no conversion arrives"
            findings.append(Finding(key, "no reading", problem, "check its supply and wiring"))
            continue
        values[key] = {"voltage": before.voltage, "current": before.current}
        values[key]["rise"] = after.current - before.current
        findings += _monitor_faults(key, power, before, after)
    faulty = {one.part for one in findings}
    return Outcome([*findings, *_disagreement(values, faulty)], {"monitors": values})


def _readings(
    session: Session, monitors: Mapping[str, PowerMonitor], command: FloatArray
) -> dict[str, PowerReading | None]:
    """Drive the coils with the currents `command` (n,), A, and return the newest readings.

    The reading of a monitor is None if it is older than these currents.
    """
    coils = session.device("coils")

    def repeat() -> None:
        coils.command(command)
        session.beat()

    begun_ns = session.rig.clock.now_ns()
    session.wait(_SETTLE_S + _MONITOR_S, repeat)
    found = {key: monitor.latest() for key, monitor in monitors.items()}
    return {key: None if one is None or one.time_ns < begun_ns else one for key, one in found.items()}


def _monitor_faults(key: str, power: Power, rest: PowerReading, driven: PowerReading) -> list[Finding]:
    """Return the fault of a monitor that its readings without and with a driven coil show, if any."""
    if rest.current == driven.current and rest.voltage == driven.voltage:
        shown = f"{rest.voltage:.2f} V, {rest.current:.3f} A"
        text = f"its readings do not change when a coil is driven ({shown})"
        cure = "switch it off and on, and check its wiring; replace it if the readings still do not change"
        return [Finding(key, "stuck", text, cure)]
    low, high = 0.9 * power.battery.voltage(0.0), 1.05 * power.battery.voltage(1.0)
    if not low <= rest.voltage <= high:
        text = f"it measures {rest.voltage:.2f} V, but the battery has {low:.2f} to {high:.2f} V"
        return [Finding(key, "wrong voltage", text, "check its wiring, fuse and plug, and `power.battery`")]
    rise = driven.current - rest.current
    if rise < -0.02:
        text = f"its current falls by {-1e3 * rise:.0f} mA when a coil is driven"
        return [Finding(key, "reversed", text, "swap the two wires at its shunt")]
    if rise < 0.01:
        text = f"its current hardly changes when a coil is driven: by {1e3 * rise:.0f} mA"
        return [Finding(key, "no current", text, "wire its shunt into the line of the battery or of the bus")]
    return []


def _disagreement(values: Mapping[str, Mapping[str, float]], faulty: set[str]) -> list[Finding]:
    if len(values) < 2 or faulty & values.keys():
        return []
    (first, a), (second, b) = values.items()
    if abs(a["voltage"] - b["voltage"]) > 0.03 * max(a["voltage"], b["voltage"]):
        text = f"{a['voltage']:.2f} V here, but {second} measures {b['voltage']:.2f} V on the same line"
        return [Finding(first, "wrong voltage", text, f"measure the voltage at {first} and {second}")]
    if abs(a["rise"] / b["rise"] - 1.0) > _NEAR:
        text = f"a coil adds {1e3 * a['rise']:.0f} mA here, but {1e3 * b['rise']:.0f} mA at {second}"
        return [Finding(first, "wrong shunt", text, f"check `shunt` of {first} and {second}")]
    return []


# GPS receiver.

_FIX_PATIENCE_S = 120.0  # longest time (s) that a receiver under an open sky needs for its first fix
_SILENCE_S = 6.0
_FIXES = 12
_NMEA_PERIOD_S = 1.0  # interval (s) between fixes of an NMEA receiver; no driver sets this interval
_LATE_S = 0.7
"""Largest age (s) of a fix at its arrival: receivers need up to 0.2 s, and slow serial lines add to this."""
_CLOCK_S = 5.0  # difference (s) between GPS time and computer time that is not explained by a late fix


def step_gps(session: Session) -> Outcome:
    """Receive fixes, and check number of satellites, rate, time, position and velocity."""
    receiver: GpsReceiver = session.device("gps")
    section = session.config.gps
    assert section is not None, "the device is open"
    period = _NMEA_PERIOD_S if section.driver == "nmea" else section.period
    silence, searches = max(_SILENCE_S, 2.0 * period), False
    session.ask("Place the GPS antenna under an open sky, and leave it there.")
    clock, before, readings = session.rig.clock, receiver.link(), list[GpsReading]()
    begun_ns = clock.now_ns()
    receiver.poll()

    def seconds() -> float:
        return (clock.now_ns() - begun_ns) * 1e-9

    while sum(one.valid for one in readings) < _FIXES and seconds() < _FIX_PATIENCE_S:
        session.wait(1.0)
        readings += receiver.poll()
        link = receiver.link()
        if seconds() <= silence:
            # The u-blox driver searches for the baud rate while bytes arrive that it cannot decode.
            decoded = link.frames + link.sentences > before.frames + before.sentences
            searches = (
                section.driver == "ublox" and link.bytes_received > before.bytes_received and not decoded
            )
        elif not readings and not searches and link.frames == before.frames:
            break
    link, span = receiver.link(), seconds()
    bad, good = link.bad_checksum - before.bad_checksum, link.frames + link.sentences
    fixes = [one for one in readings if one.valid]
    offsets = [_offset(one, clock.now_ns(), clock.utc_ns()) for one in fixes]
    values = {
        "fixes": len(fixes),
        "satellites": max((one.satellites for one in readings), default=0),
        "offset_s": float(np.median(offsets)) if offsets else None,
    }
    corrupted = bad / max(good - before.frames - before.sentences + bad, 1)
    findings = _gps_stream(readings, corrupted, period)
    if not fixes:
        if not readings:
            text = f"no navigation solution arrives in {span:.0f} s: {link.condition or 'check its output'}"
            findings.append(Finding("gps", "no answer", text, "check power, baud rate and wires"))
        else:
            text = f"no fix in {span:.0f} s, with {values['satellites']} satellites"
            cure = "check the antenna, its cable and its supply, and that it sees the open sky"
            findings.append(Finding("gps", "no fix", text, cure))
        return Outcome(findings, values)
    return Outcome([*findings, *_gps_faults(fixes, float(np.median(offsets)))], values)


def _offset(reading: GpsReading, now_ns: int, utc_ns: int) -> float:
    """Return the computer's UTC at the arrival of a fix minus the UTC of the fix, s."""
    return (utc_ns - (now_ns - reading.arrival_ns) - reading.utc_ns) * 1e-9


def _gps_stream(readings: Sequence[GpsReading], bad: float, period: float) -> list[Finding]:
    """Return the faults in the stream of readings, which should have the interval `period`, s.

    The fraction of messages with wrong checksums is `bad`.
    """
    findings = []
    if bad > 0.02:
        text = f"{100.0 * bad:.0f} % of the messages have a wrong checksum"
        cure = "check the ground wire and the length of the cable, or lower the baud rate"
        findings.append(Finding("gps", "corrupted messages", text, cure))
    if len(readings) < 4:
        return findings
    gaps = np.diff([one.arrival_ns for one in readings]) * 1e-9
    typical = float(np.median(gaps))
    if gaps.max() > 2.5 * typical and bad <= 0.02:
        text = f"the messages stop for up to {gaps.max():.1f} s"
        cure = "check plugs and solder joints for loose contact, and its supply"
        findings.append(Finding("gps", "intermittent", text, cure))
    elif not 0.6 * period < typical < 1.5 * period and bad <= 0.02:
        text = f"a message every {typical:.2f} s instead of every {period:g} s"
        findings.append(Finding("gps", "wrong rate", text, "check its rate and the baud rate"))
    return findings


def _gps_faults(fixes: Sequence[GpsReading], offset: float) -> list[Finding]:
    """Return the faults of a GPS receiver, found from time, position and velocity of its valid fixes."""
    utc, positions = np.array([one.utc_ns for one in fixes]), np.array([one.position for one in fixes])
    if len(fixes) > 2 and (np.diff(utc) == 0).mean() > 0.5:
        text = f"its time does not advance in {len(fixes)} fixes"
        cure = "switch it off and on; replace it if the time still does not advance"
        return [Finding("gps", "stuck", text, cure)]
    findings = []
    if abs(offset) > _CLOCK_S:
        text = f"its time differs from that of this computer by {-offset:.0f} s"
        cure = "set the computer's clock by a time server; if the difference stays, replace the receiver"
        findings.append(Finding("gps", "wrong time", text, cure))
    elif offset > _LATE_S:
        text = f"a fix arrives {offset:.1f} s after its time stamp"
        findings.append(Finding("gps", "late", text, "raise `baud_rate`, and switch other messages off"))
    if len(fixes) > 2:
        spans = np.diff(utc)[:, None] * 1e-9
        velocities = np.array([one.velocity for one in fixes])
        jumps = np.diff(positions, axis=0) - 0.5 * spans * (velocities[1:] + velocities[:-1])
        largest = float(np.linalg.norm(jumps, axis=1).max())
        sigma = float(np.nanmax([one.sigma for one in fixes] + [0.0]))
        if largest > 50.0 + 6.0 * sigma:
            text = f"its position jumps by {largest:.0f} m more than its velocity explains"
            cure = "check the antenna and its surroundings for reflections and radio transmitters"
            findings.append(Finding("gps", "inconsistent", text, cure))
    return findings


# Solar strings.

_STRINGS_S = 2.5  # time (s) in which each string is measured at least twice


def step_strings(session: Session) -> Outcome:
    """Illuminate one panel after the other, and check that its string has the largest relative current."""
    strings: SolarStrings = session.device("solar_strings")
    section = session.config.solar_strings
    assert section is not None, "the device is open"
    session.ask("Cover all solar panels.")
    dark = _currents(session, strings, np.zeros(3))
    normals = np.array([one.normal for one in section.strings])
    peaks = np.array([one.peak for one in section.strings])
    findings: list[Finding] = []
    lit = np.zeros((len(peaks), len(peaks)))
    for number, normal in enumerate(normals):
        outward = tuple(normal.tolist())
        session.ask(f"Shine a lamp onto the panel of string {number + 1} only, normal {outward}.")
        lit[number] = _currents(session, strings, normal) - dark
    alike = normals @ normals.T > 0.99 * np.linalg.norm(normals, axis=1) ** 2
    if (lit == 0.0).all():
        text = f"no current changes when a panel is lit (largest {1e3 * float(dark.max()):.0f} mA)"
        findings.append(Finding("solar_strings", "stuck", text, "switch the converters off and on"))
        return Outcome(findings, {"currents": lit.tolist()})
    for number, row in enumerate(lit):
        part = f"solar_strings.strings[{number}]"
        shown = int(np.argmax(row / peaks))
        if dark[number] > 0.05 * peaks[number]:
            text = f"{1e3 * float(dark[number]):.0f} mA in the dark"
            cure = "cover the panel completely; check its amplifier"
            findings.append(Finding(part, "current in the dark", text, cure))
        if row[shown] < 0.03 * peaks[shown]:
            text = f"a lamp on its panel gives {1e3 * float(row[number]):.0f} mA"
            findings.append(Finding(part, "dead", text, "check cells, diode, plug and amplifier"))
        elif not alike[number, shown]:
            text = f"a lamp on its panel gives a current in string {shown + 1}"
            cure = "swap the plugs, or `address` and `channel` of the two strings"
            findings.append(Finding(part, "exchanged", text, cure))
    return Outcome(findings, {"currents": lit.round(4).tolist()})


def _currents(session: Session, strings: SolarStrings, normal: FloatArray) -> FloatArray:
    """Return the string currents (n,), A, under a lamp along `normal`.

    Raises StepSkipped if no currents arrive.
    """
    if session.hand is not None:
        session.hand.light(normal)
    begun_ns = session.rig.clock.now_ns()
    session.wait(_STRINGS_S)
    reading = strings.latest()
    if reading is None or reading.time_ns < begun_ns + round(0.5 * _STRINGS_S * SECOND_NS):
        problem = strings.error() or "no conversion arrives"
        finding = Finding("solar_strings", "no reading", problem, "check supply and wiring of the converters")
        raise StepSkipped("the solar strings give no reading", finding)
    return reading.currents
