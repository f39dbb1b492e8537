"""The steps of a bench session with real or emulated devices.

Each step returns its findings, its measured values and the resulting changes of the configuration. The
coils are driven only in the steps `coils` and `power`, one at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import msgspec
import numpy as np

from flight.schema.sections import Config
from ground.bringup import diagnosis
from ground.bringup.bench import STILL_S, Outcome, Session, StepSkipped, find
from ground.bringup.cameras import step_dark, step_focus, step_lens, step_light, step_wide
from ground.bringup.diagnosis import Finding, Samples
from ground.bringup.satellite import step_gps, step_power, step_strings
from hal.interfaces.devices import COIL_NAMES, InertialUnit, PowerMonitor, TorqueCoils
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_matrix

_REST_S = 12.0
_SETTLE_S = 0.3
_DRIVE_S = 1.2
_EARTH_FIELD = 7.5e-5  # largest magnetic field (T) of a laboratory without a Helmholtz coil
_DENSITIES = math.radians(0.0035), 1.4e-8, 0.14e-3 * 9.80665
"""Noise densities of a VN-100 per sqrt(Hz) [data sheet]: gyro (rad/s), field (T), acceleration (m/s^2)."""


def step_find(session: Session) -> Outcome:
    """Find each device and identify it."""
    found = list(find(session.config, session.rig))
    answers = {one.part: f"{one.place}: {one.answer or 'no answer'}" for one in found}
    findings = [one.finding for one in found if one.finding]
    changes = {one.part: dict([one.setting]) for one in findings if one.setting is not None}
    return Outcome(findings, {"answers": answers}, changes)


def expectation(config: Config) -> diagnosis.UnitExpectation:
    """Return the expected sample rate and noise of the inertial unit, from data sheet and configuration."""
    unit = config.inertial_unit
    if getattr(unit, "driver", "vn100") != "vn100":
        return diagnosis.UnitExpectation(unit.rate_hz, max(unit.rate_noise, 1e-3), 1e-6, 0.05)
    gyro, field_noise, force = (density * math.sqrt(0.5 * unit.rate_hz) for density in _DENSITIES)
    return diagnosis.UnitExpectation(unit.rate_hz, max(gyro, unit.rate_noise), field_noise, force)


def step_rest(session: Session) -> Outcome:
    """Measure sample rate, noise and mean values of the inertial unit at rest."""
    unit: InertialUnit = session.device("inertial_unit")
    session.ask("Let the body stand still, with its z axis up, away from iron.")
    expected, before, begun_ns = expectation(session.config), unit.link(), session.rig.clock.now_ns()
    samples = session.record(_REST_S)
    span, link = (session.rig.clock.now_ns() - begun_ns) * 1e-9, unit.link()
    packets = link.packets - before.packets
    bad = link.bad_checksum - before.bad_checksum
    plant = getattr(session.config, "plant", None)
    strongest = _EARTH_FIELD if plant is None else max(_EARTH_FIELD, 1.3 * plant.field)
    findings = diagnosis.diagnose_rest(samples, span, expected, bad / max(packets + bad, 1), strongest)
    if len(samples.times) < diagnosis.FEWEST:
        return Outcome(findings, {"samples": len(samples.times)})
    measured = {"gyro": samples.rate, "field": samples.field, "acceleration": samples.acceleration}
    noise = {name: diagnosis.noise_of(sensor).tolist() for name, sensor in measured.items()}
    values = {
        "rate_hz": len(samples.times) / span,
        "noise": noise,
        "expected": {name: getattr(expected, name) for name in measured},
        "bias": samples.rate.mean(axis=0).tolist(),
        "field": samples.field.mean(axis=0).tolist(),
        "acceleration": samples.acceleration.mean(axis=0).tolist(),
    }
    changes = {} if findings else {"inertial_unit": {"rate_noise": round(max(noise["gyro"]), 9)}}
    times, deviation = diagnosis.allan_deviation(samples.rate, 1.0 / session.config.inertial_unit.rate_hz)
    arrays = {"times": samples.times - samples.times[0], "rate": samples.rate, "field": samples.field}
    arrays |= {"allan_times": times, "allan": deviation}
    return Outcome(findings, values, changes, arrays)


def step_axes(session: Session) -> Outcome:
    """Measure the axes of gyro, accelerometer and magnetometer by rotations by hand about each body axis."""
    gyro, before, after = np.zeros((3, 3)), np.zeros((3, 2, 3)), np.zeros((3, 2, 3))
    seconds = 8.0
    for index, name in enumerate("xyz"):
        if session.hand is not None:
            session.hand.turn(np.eye(3)[index], 0.0, 1.0)
            seconds = 2.5
        turn = f"turn it right-handed by 90 deg about its {name} axis within {seconds - 2.0:g} s"
        session.ask(f"Stand the body with its z axis up. After Enter, wait 1 s, {turn}, and hold it.")
        still = session.record(STILL_S)
        if session.hand is not None:
            session.hand.turn(np.eye(3)[index], diagnosis.QUARTER, seconds - 0.5)
        moving, held = session.record(seconds), session.record(STILL_S)
        gyro[index] = diagnosis.turned(moving, still.rate.mean(axis=0))
        before[index] = still.acceleration.mean(axis=0), still.field.mean(axis=0)
        after[index] = held.acceleration.mean(axis=0), held.field.mean(axis=0)
    if session.hand is not None:
        session.hand.turn(np.eye(3)[0], 0.0, 1.0)
    found = diagnosis.diagnose_axes(diagnosis.Turns(gyro, before, after))
    named = {"gyro": found.gyro, "accelerometer": found.accelerometer, "magnetometer": found.magnetometer}
    axes = {name: None if matrix is None else np.round(matrix, 4).tolist() for name, matrix in named.items()}
    changes = _mounting(session.config, found.gyro, found.findings)
    values = {"turns_deg": np.degrees(gyro).round(2).tolist(), "axes": axes}
    return Outcome(found.findings, values, changes, {"turns": gyro})


def _mounting(config: Config, axes: FloatArray | None, findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the mounting that explains the measured axes, if all sensors of the unit are rotated equally."""
    rotated = any(one.part == "inertial_unit" and one.kind == "rotated" for one in findings)
    if axes is None or not rotated:
        return {}
    to_body = axes.T @ attitude_matrix(np.array(config.inertial_unit.mounting))
    return {"inertial_unit": {"mounting": np.round(from_matrix(to_body), 8).tolist()}}


_RELATIVE = "along each coil's axis, relative to the coils' median field"


def step_coils(session: Session) -> Outcome:
    """Drive each coil in both directions, and compare its field and its current with the expected ones."""
    coils: TorqueCoils = session.device("coils")
    session.device("inertial_unit")
    section, axes = session.config.coils, session.known.get("axes", Outcome()).values.get("axes", {})
    monitor: PowerMonitor | None = None
    with suppress(StepSkipped):  # without a current monitor, only the fields of the coils are compared
        monitor = session.device("power_monitor")
    session.ask("Let the body stand still, and keep iron and magnets away. The coils are driven now.")
    reach = section.supply_voltage / np.array(section.resistance)
    commanded = np.minimum(np.array(section.limits), reach)[: len(section.windings)]
    try:
        test = _drive(session, coils, monitor, commanded)
    finally:
        coils.off()
    given = session.coil_field
    expected = given if given is not None else np.array([coil.direction() for coil in section.windings])
    magnetometer = axes.get("magnetometer")
    sensor = None if magnetometer is None else np.array(magnetometer)
    names = COIL_NAMES[: len(section.windings)]
    found = diagnosis.diagnose_coils(test, expected, names, sensor, size_known=given is not None)
    axes_findings = session.known.get("axes", Outcome()).findings
    if any(one.part == "inertial_unit.magnetometer" and one.kind == "wrong scale" for one in axes_findings):
        found.findings[:] = [one for one in found.findings if one.kind != "wrong strength"]
    if test.fault:
        found.findings.insert(0, Finding("coils", "refused", test.fault, "check the bus and the PWM chip"))
    if monitor is not None and math.isnan(test.idle):
        problem = monitor.error() or "no conversion arrives"
        found.findings.append(Finding("power_monitor", "no reading", problem, "check its supply and wiring"))
    # If a leg is stuck high, current flows through the coil while the bridge is off, but not while it brakes.
    if any(one.kind == "current while off" for one in found.findings):
        coils.brake(frozenset(range(len(section.windings))))
        session.hold_brake()
    values = {
        "commanded": commanded.tolist(),
        "volts": [None if math.isnan(v) else round(v, 3) for v in test.volts],
        "response": found.response.tolist(),
        "strength": found.strength.round(4).tolist(),
        "serves": found.serves,
        "current": [[None if math.isnan(v) else round(v, 5) for v in row] for row in test.current.tolist()],
        "expected": "configured" if given is not None else _RELATIVE,
    }
    arrays = {"response": found.response, "expected": found.expected, "strength": found.strength}
    arrays |= {"current": test.current, "commanded": commanded}
    changes = _coil_changes(session.config, found, test.clipped, axes_known=given is None)
    return Outcome(found.findings, values, changes, arrays)


def _drive(
    session: Session, coils: TorqueCoils, monitor: PowerMonitor | None, commanded: FloatArray
) -> diagnosis.CoilTest:
    count, slots = len(commanded), len(session.config.coils.slots)
    fields, currents = np.zeros((count, 2, 3)), np.full((count, 2), math.nan)
    absent, volts = np.zeros((count, 2)), np.full((count, 3), math.nan)
    idle: list[float] = []
    spread: list[float] = []
    recorded: list[Samples] = []
    clipped: list[bool] = []
    fault = ""

    def measured(command: FloatArray) -> tuple[FloatArray, float]:
        """Return the fields (k, 3), T, and the mean supply current, A, while `command` is repeated."""
        drawn: dict[int, float] = {}

        def repeat() -> None:
            coils.command(command)
            session.beat()
            reading = None if monitor is None else monitor.latest()
            if reading is not None and reading.newest_since_ns >= settled_ns:
                drawn[reading.time_ns] = reading.newest
                clipped.append(reading.clipped)

        settled_ns = session.rig.clock.now_ns() + round(_SETTLE_S * SECOND_NS)
        session.wait(_SETTLE_S, repeat)
        samples = session.record(_DRIVE_S, repeat)
        spread.append(diagnosis.noise_of(samples.field).max() / math.sqrt(len(samples.times)))
        recorded.append(samples)
        return samples.field, float(np.mean(list(drawn.values()))) if drawn else math.nan

    zero = np.zeros(slots)
    for index in range(count):
        at_rest, still = measured(zero)
        rest = at_rest.mean(axis=0)
        idle.append(still)
        volts[index, 0] = _voltage(monitor)
        for way, sign in enumerate((1.0, -1.0)):
            command = zero.copy()
            command[index] = sign * commanded[index]
            driven, current = measured(command)
            fields[index, way] = sign * (driven.mean(axis=0) - rest) / commanded[index]
            absent[index, way] = diagnosis.missing_share(driven - rest, diagnosis.noise_of(at_rest).max())
            currents[index, way] = current - still
            volts[index, 1 + way] = _voltage(monitor)
            fault = fault or coils.state().error
    measured(zero)
    noise = 2.0 * float(np.mean(spread)) / float(commanded.min())
    sensed = not any(
        one.part == "inertial_unit.magnetometer" and one.kind in {"stuck", "dead"}
        for one in session.known.get("rest", Outcome()).findings
    )
    resting, supply = float(np.mean(idle)), (float(np.max(volts[:, 0])), float(np.min(volts[:, 1:])))
    plus, minus, clips = fields[:, 0], fields[:, 1], any(clipped)
    rotation, ambient = _rotation(session, recorded), float(np.linalg.norm(recorded[0].field.mean(axis=0)))
    return diagnosis.CoilTest(
        commanded,
        plus,
        minus,
        currents,
        resting,
        noise,
        absent,
        fault,
        clips,
        supply,
        sensed,
        rotation,
        ambient,
    )


def _rotation(session: Session, recorded: Sequence[Samples]) -> float:
    """Return the largest rotation (rad) of the body between two successive recordings.

    The gyro's bias is that of the step `rest`, or else the mean rate of all recordings. The rotation is 0
    for a gyro whose rates are not finite.
    """
    rates = np.array([samples.rate.mean(axis=0) for samples in recorded])
    times = np.array([samples.times.mean() for samples in recorded])
    rest = session.known.get("rest", Outcome())
    sound = not any(one.part == "inertial_unit.gyro" for one in rest.findings)
    bias = np.array(rest.values["bias"]) if sound and "bias" in rest.values else rates.mean(axis=0)
    turned = 0.5 * (rates[1:] + rates[:-1] - 2.0 * bias) * np.diff(times)[:, None]
    return float(np.nan_to_num(np.linalg.norm(turned, axis=1)).max(initial=0.0))


def _voltage(monitor: PowerMonitor | None) -> float:
    """Return the supply voltage (V) of the newest reading, or NaN."""
    reading = None if monitor is None else monitor.latest()
    return math.nan if reading is None else reading.voltage


def _coil_changes(
    config: Config, found: diagnosis.CoilsFound, clipped: bool, *, axes_known: bool
) -> dict[str, Any]:
    """Return the corrected configuration values of windings and shunt, given the findings for each coil.

    If `axes_known` is false, the axes of the coils are not changed, because a coil's field at the
    magnetometer need not be parallel to the axis of the coil.
    """
    kinds = {(one.part, one.kind): one for one in found.findings}
    windings = [
        {name: value for name, value in msgspec.to_builtins(coil).items() if value is not None}
        | {"channels": list(coil.pins(index))}
        for index, coil in enumerate(config.coils.windings)
    ]
    changed = False
    for j, coil in enumerate(config.coils.windings):
        part, k = f"coils.windings[{j}]", found.serves[j]
        moved = (part, "exchanged") in kinds
        if moved:
            windings[k]["channels"] = list(coil.pins(j))
        if moved or (part, "reversed") in kinds:
            windings[k]["sign"] = coil.sign * (-1 if found.strength[j] < 0 else 1)
        resistance = kinds.get((part, "wrong resistance"))
        if resistance is not None and resistance.factor is not None:
            # The driver computes the duty cycle of command j from the resistance of winding j, not of coil k.
            windings[k]["resistance"] = round(coil.resistance * resistance.factor, 3)
        tilted = axes_known and (part, "wrong direction") in kinds
        if tilted:
            along = coil.sign * found.response[j] / np.linalg.norm(found.response[j])
            windings[j]["axis"] = along.round(4).tolist()
        changed = changed or moved or tilted or (part, "reversed") in kinds or resistance is not None
    changes: dict[str, Any] = {"coils": {"windings": windings}} if changed else {}
    if ("power_monitor", "wrong shunt") in kinds and not clipped and config.power_monitor is not None:
        changes["power_monitor"] = {"shunt": float(f"{config.power_monitor.shunt * found.shunt:.3g}")}
    return changes


STEPS: dict[str, Callable[[Session], Outcome]] = {
    "find": step_find,
    "rest": step_rest,
    "axes": step_axes,
    "coils": step_coils,
    "power": step_power,
    "gps": step_gps,
    "strings": step_strings,
    "wide": step_wide,
    "dark": step_dark,
    "light": step_light,
    "focus": step_focus,
    "lens": step_lens,
}
"""Functions of the steps by name, in the order of execution."""


def steps_of(config: Config) -> list[str]:
    """Return the names of the steps for the devices of a configuration."""
    optional = {"power": config.power, "gps": config.gps, "strings": config.solar_strings}
    without = {name for name, section in optional.items() if section is None}
    if not config.wide_cameras:
        without.add("wide")
    return [name for name in STEPS if name not in without]
