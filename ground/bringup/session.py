"""The measurements of a bench session, step by step, with real or emulated devices.

Each step returns its findings, its measured values and the changes of the configuration that follow. The
coils are driven only in the step `coils`, one at a time. The driver sets a coil to zero if its command is
not repeated within 0.25 s, the guardian if this process stops, and `Session.close` in any case.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from typing import Any, cast

import msgspec
import numpy as np

from flight.app.devices import open_camera, opened
from flight.schema.sections import Config
from ground.bringup.devices import find
from ground.bringup.diagnosis import (
    FEWEST,
    QUARTER,
    UNRECOGNISED,
    CoilsFound,
    CoilTest,
    Finding,
    Samples,
    Turns,
    UnitExpectation,
    allan_deviation,
    diagnose_axes,
    diagnose_coils,
    diagnose_rest,
    noise_of,
    turned,
)
from hal.interfaces.devices import (
    COIL_NAMES,
    Frame,
    FrameSource,
    ImuReading,
    InertialUnit,
    PowerMonitor,
    TorqueCoils,
)
from hal.interfaces.errors import DeviceError, NotResponding
from hal.interfaces.guardian import CoilGuardian
from hal.interfaces.wires import SECOND_NS, Rig
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, from_matrix
from knightcube.vision.lens_calibration import MIN_STARS, calibrate_lens
from knightcube.vision.startracker.detection.detect import detect

_POLL_NS = 25_000_000
_REST_S = 12.0
_STILL_S = 0.5
_SETTLE_S = 0.3
_DRIVE_S = 1.2
_FRAMES = 3
_LENS_FRAMES = 6
_FRAME_PATIENCE_NS = 12 * SECOND_NS
_EARTH_FIELD = 7.5e-5
"""Largest magnetic field (T) of a laboratory without a Helmholtz coil."""
_FEW_SOURCES = 5
"""Number of point sources from which a frame shows stars or lamps, not hot pixels."""
_SHARP = (0.6, 2.5)
"""Range (px) of a star's PSF width, standard deviation, in which stars are measured well."""
_DENSITIES = math.radians(0.0035), 1.4e-8, 0.14e-3 * 9.80665
"""Noise densities of a VN-100 per sqrt(Hz) [data sheet]: gyro (rad/s), field (T), acceleration (m/s^2)."""


class StepSkipped(Exception):
    """Raised by a step that cannot be done; the text is the reason, `finding` the fault that caused it."""

    def __init__(self, reason: str, finding: Finding | None = None) -> None:
        super().__init__(reason)
        self.finding = finding


@dataclass(slots=True)
class Outcome:
    """The result of a step.

    Attributes:
        findings: faults of the parts.
        values: measured values for the report and for JSON.
        changes: values of the configuration that the measurements give, by section.
        arrays: measured arrays for the pictures.
        frames: frames for the report.
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
        stack: closes every device that was opened.
        ask: function that requests an action of the person at the bench and waits for its completion.
        hand: the emulated hand (`sim_hal.rig.EmulatedBench`), or None at a real bench.
        guardian: guardian of the coils, or None with emulated devices.
        coil_field: expected field of each coil (n, 3) at the magnetometer, T/A, body axes, or None.
        known: outcomes of earlier steps, by name.
        live: whether somebody watches the focus until he or she ends the step.
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

    def device(self, kind: str) -> Any:
        """Return the open device of a section. Raises StepSkipped if it is not configured or not found."""
        if kind not in self._open:
            missing = [one for one in self.known.get("find", Outcome()).findings if one.part == kind]
            if missing:
                raise StepSkipped(f"{kind} was not found ({missing[0].kind})")
            if getattr(self.config, kind) is None:
                raise StepSkipped(f"the configuration has no {kind}")
            try:
                self._open[kind] = self._opened(kind)
            except DeviceError as error:
                finding = Finding(kind, "refused", error.message, "check power and wiring; repeat the step")
                raise StepSkipped(f"{kind} could not be opened", finding) from error
        return self._open[kind]

    def _opened(self, kind: str) -> Any:
        if kind == "camera":
            if self.rig.cameras is not None:
                return self.rig.cameras[0]
            assert self.config.camera is not None, "the caller checks that the configuration has a camera"
            return open_camera(self.config.camera, self.rig, self.stack)
        device = opened(kind, self.config, self.rig, self.stack)
        if kind == "coils":
            cast(TorqueCoils, device).start()
        if kind == "inertial_unit":
            cast(InertialUnit, device).configure()
            self.wait(_STILL_S)
            device.poll()
        return device

    def wait(self, seconds: float, each: Callable[[], None] | None = None) -> None:
        """Wait, and call `each` every 25 ms."""
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
            text = (
                f"{len(readings)} valid samples and {link.packets - before.packets} packets in {seconds:g} s"
            )
            finding = Finding(
                "inertial_unit", "no samples", text, "switch it off and on, and check the cable"
            )
            raise StepSkipped("the inertial unit sends too few samples", finding)
        columns = [
            np.array([getattr(reading, name) for reading in readings], dtype=float).reshape(-1, 3)
            for name in ("rate", "field", "acceleration")
        ]
        return Samples(np.array([reading.time_ns for reading in readings]) * 1e-9, *columns)

    def frame(self) -> Frame:
        """Return a frame of the star camera. Raises StepSkipped if none arrives."""
        source: FrameSource = self.device("camera")
        assert self.config.camera is not None, "the device is open"
        clock = self.rig.clock
        try:
            source.trigger(round(self.config.camera.exposure * SECOND_NS))
            until_ns = clock.now_ns() + _FRAME_PATIENCE_NS
            while (frame := source.poll()) is None:
                if clock.now_ns() > until_ns:
                    raise NotResponding("camera", "no frame arrives within 12 s of the trigger")
                clock.sleep_until_ns(clock.now_ns() + _POLL_NS)
        except DeviceError as error:
            finding = Finding("camera", "no frame", error.message, "check its cable, power and trigger")
            raise StepSkipped("the camera delivers no frame", finding) from error
        return frame

    def close(self) -> None:
        """Set the coils to zero and close all devices."""
        if "coils" in self._open:
            self._open["coils"].off()
        self.stack.close()


# Steps.


def step_find(session: Session) -> Outcome:
    """Find each device and identify it."""
    found = list(find(session.config, session.rig, session.stack))
    answers = {one.part: f"{one.place}: {one.answer or 'no answer'}" for one in found}
    return Outcome([one.finding for one in found if one.finding], {"answers": answers})


def expectation(config: Config) -> UnitExpectation:
    """Return the rate and the noise that the inertial unit should have, by data sheet and configuration."""
    unit = config.inertial_unit
    if getattr(unit, "driver", "vn100") != "vn100":
        return UnitExpectation(unit.rate_hz, max(unit.rate_noise, 1e-3), 1e-6, 0.05)
    gyro, field_noise, force = (density * math.sqrt(0.5 * unit.rate_hz) for density in _DENSITIES)
    return UnitExpectation(unit.rate_hz, max(gyro, unit.rate_noise), field_noise, force)


def step_rest(session: Session) -> Outcome:
    """Measure rate, noise and mean values of the inertial unit at rest."""
    unit: InertialUnit = session.device("inertial_unit")
    session.ask("Let the body stand still, with its z axis up, away from iron.")
    expected, before, begun_ns = expectation(session.config), unit.link(), session.rig.clock.now_ns()
    samples = session.record(_REST_S)
    span, link = (session.rig.clock.now_ns() - begun_ns) * 1e-9, unit.link()
    packets = link.packets - before.packets
    bad = link.bad_checksum - before.bad_checksum
    plant = getattr(session.config, "plant", None)
    strongest = _EARTH_FIELD if plant is None else max(_EARTH_FIELD, 1.3 * plant.field)
    findings = diagnose_rest(samples, span, expected, bad / max(packets + bad, 1), strongest)
    if len(samples.times) < FEWEST:
        return Outcome(findings, {"samples": len(samples.times)})
    noise = {
        "gyro": noise_of(samples.rate).tolist(),
        "field": noise_of(samples.field).tolist(),
        "acceleration": noise_of(samples.acceleration).tolist(),
    }
    values = {
        "rate_hz": len(samples.times) / span,
        "noise": noise,
        "expected": {
            "gyro": expected.gyro,
            "field": expected.field,
            "acceleration": expected.acceleration,
        },
        "bias": samples.rate.mean(axis=0).tolist(),
        "field": samples.field.mean(axis=0).tolist(),
        "acceleration": samples.acceleration.mean(axis=0).tolist(),
    }
    changes = {} if findings else {"inertial_unit": {"rate_noise": round(max(noise["gyro"]), 9)}}
    times, deviation = allan_deviation(samples.rate, 1.0 / session.config.inertial_unit.rate_hz)
    arrays = {"times": samples.times - samples.times[0], "rate": samples.rate, "field": samples.field}
    arrays |= {"allan_times": times, "allan": deviation}
    return Outcome(findings, values, changes, arrays)


def step_axes(session: Session) -> Outcome:
    """Measure the axes of gyro, accelerometer and magnetometer by a turn about each body axis."""
    gyro, before, after = np.zeros((3, 3)), np.zeros((3, 2, 3)), np.zeros((3, 2, 3))
    seconds = 8.0
    for index, name in enumerate("xyz"):
        if session.hand is not None:
            session.hand.turn(np.eye(3)[index], 0.0, 1.0)
            seconds = 2.5
        session.ask(
            f"Stand the body with its z axis up. After Enter, wait 1 s, turn it right-handed by 90 deg about "
            f"its {name} axis within {seconds - 2.0:g} s, and hold it."
        )
        still = session.record(_STILL_S)
        if session.hand is not None:
            session.hand.turn(np.eye(3)[index], QUARTER, seconds - 0.5)
        moving, held = session.record(seconds), session.record(_STILL_S)
        gyro[index] = turned(moving, still.rate.mean(axis=0))
        before[index] = still.acceleration.mean(axis=0), still.field.mean(axis=0)
        after[index] = held.acceleration.mean(axis=0), held.field.mean(axis=0)
    if session.hand is not None:
        session.hand.turn(np.eye(3)[0], 0.0, 1.0)
    found = diagnose_axes(Turns(gyro, before, after))
    named = {"gyro": found.gyro, "accelerometer": found.accelerometer, "magnetometer": found.magnetometer}
    axes = {name: None if matrix is None else np.round(matrix, 4).tolist() for name, matrix in named.items()}
    changes = _mounting(session.config, found.gyro, found.findings)
    values = {"turns_deg": np.degrees(gyro).round(2).tolist(), "axes": axes}
    return Outcome(found.findings, values, changes, {"turns": gyro})


def _mounting(config: Config, axes: FloatArray | None, findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the mounting that explains the measured axes, if all sensors of the unit are rotated alike."""
    rotated = any(one.part == "inertial_unit" and one.kind == "rotated" for one in findings)
    if axes is None or not rotated:
        return {}
    to_body = axes.T @ attitude_matrix(np.array(config.inertial_unit.mounting))
    return {"inertial_unit": {"mounting": np.round(from_matrix(to_body), 8).tolist()}}


def step_coils(session: Session) -> Outcome:
    """Drive each coil in both directions, and compare its field and its current with the expected ones."""
    coils: TorqueCoils = session.device("coils")
    session.device("inertial_unit")
    section, axes = session.config.coils, session.known.get("axes", Outcome()).values.get("axes", {})
    monitor: PowerMonitor | None = None
    with suppress(StepSkipped):  # without a monitor the coils are compared by their fields alone
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
    found = diagnose_coils(
        test,
        expected,
        COIL_NAMES[: len(section.windings)],
        None if magnetometer is None else np.array(magnetometer),
        size_known=given is not None,
    )
    if test.fault:
        found.findings.insert(0, Finding("coils", "refused", test.fault, "check the bus and the PWM chip"))
    if monitor is not None and math.isnan(test.idle):
        problem = monitor.error() or "no conversion arrives"
        found.findings.append(Finding("power_monitor", "no reading", problem, "check its supply and wiring"))
    if any(one.kind == "current while off" for one in found.findings):  # a braked bridge drives no current
        coils.brake(frozenset(range(len(section.windings))))
    values = {
        "commanded": commanded.tolist(),
        "response": found.response.tolist(),
        "strength": found.strength.round(4).tolist(),
        "serves": found.serves,
        "current": [[None if math.isnan(v) else round(v, 5) for v in row] for row in test.current.tolist()],
        "expected": "configured"
        if given is not None
        else "along each coil's axis, relative to the coils' median field",
    }
    arrays = {"response": found.response, "expected": found.expected, "strength": found.strength}
    arrays |= {"current": test.current, "commanded": commanded}
    return Outcome(found.findings, values, _coil_changes(session.config, found, test.clipped), arrays)


def _drive(
    session: Session, coils: TorqueCoils, monitor: PowerMonitor | None, commanded: FloatArray
) -> CoilTest:
    """Drive each coil in both directions, and return the measured fields and currents."""
    count, slots = len(commanded), len(session.config.coils.slots)
    fields, currents = np.zeros((count, 2, 3)), np.full((count, 2), math.nan)
    idle: list[float] = []
    spread: list[float] = []
    clipped: list[bool] = []
    fault = ""

    def measured(command: FloatArray) -> tuple[FloatArray, float]:
        """Return the mean field (3,) and supply current while `command` is repeated."""
        drawn: dict[int, float] = {}

        def repeat() -> None:
            coils.command(command)
            if session.guardian is not None:
                session.guardian.beat()
            reading = None if monitor is None else monitor.latest()
            if reading is not None and reading.newest_since_ns >= settled_ns:
                drawn[reading.time_ns] = reading.newest
                clipped.append(reading.clipped)

        settled_ns = session.rig.clock.now_ns() + round(_SETTLE_S * SECOND_NS)
        session.wait(_SETTLE_S, repeat)
        samples = session.record(_DRIVE_S, repeat)
        spread.append(noise_of(samples.field).max() / math.sqrt(len(samples.times)))
        return samples.field.mean(axis=0), float(np.mean(list(drawn.values()))) if drawn else math.nan

    zero = np.zeros(slots)
    for index in range(count):
        rest, still = measured(zero)
        idle.append(still)
        for way, sign in enumerate((1.0, -1.0)):
            command = zero.copy()
            command[index] = sign * commanded[index]
            driven, current = measured(command)
            fields[index, way] = sign * (driven - rest) / commanded[index]
            currents[index, way] = current - still
            fault = fault or coils.state().error
    measured(zero)
    noise = 2.0 * float(np.mean(spread)) / float(commanded.min())
    return CoilTest(
        commanded, fields[:, 0], fields[:, 1], currents, float(np.mean(idle)), noise, fault, any(clipped)
    )


def _coil_changes(config: Config, found: CoilsFound, clipped: bool) -> dict[str, Any]:
    """Return the changes of windings and shunt that the findings about single coils imply."""
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
            windings[k]["resistance"] = round(windings[k]["resistance"] * resistance.factor, 3)
        changed = changed or moved or (part, "reversed") in kinds or resistance is not None
    changes: dict[str, Any] = {"coils": {"windings": windings}} if changed else {}
    if ("power_monitor", "wrong shunt") in kinds and not clipped and config.power_monitor is not None:
        changes["power_monitor"] = {"shunt": float(f"{config.power_monitor.shunt * found.shunt:.3g}")}
    return changes


# Camera.


def step_dark(session: Session) -> Outcome:
    """Take frames with the lens cap on: level, noise and hot pixels."""
    session.device("camera")
    session.ask("Put the cap on the lens of the camera.")
    if session.hand is not None:
        session.hand.cover(True)
    taken = [session.frame() for _ in range(_FRAMES)]
    frames = [frame.pixels for frame in taken]
    if session.hand is not None:
        session.hand.cover(False)
    camera = session.config.camera
    assert camera is not None, "the device is open"
    first, second = (pixels.astype(float) for pixels in frames[-2:])
    level = float(np.median(second))
    noise = float(1.4826 * np.median(np.abs(second - first - np.median(second - first))) / math.sqrt(2.0))
    hot = float(np.mean(second > level + 10.0 * max(noise, 1.0)))
    sources = len(detect(frames[-1]).stars())
    findings = _frozen(taken)
    bright = level >= 0.9 * (camera.saturation or float(2**camera.bits - 1))
    if findings:
        pass
    elif sources >= _FEW_SOURCES or bright:
        text = f"{sources} point sources and {level:.0f} counts although the cap should be on"
        findings.append(Finding("camera", "lens cap off", text, "put the cap on, and repeat the step"))
    elif noise == 0.0 and level > 0.0:  # a camera with a low black level may show zeros behind its cap
        text = f"all frames are equal ({level:.0f} counts)"
        findings.append(Finding("camera", "no signal", text, "check sensor, cable, gain and `pixel_format`"))
    elif noise * camera.gain > 3.0 * camera.read_noise + 5.0:
        text = f"read noise {noise * camera.gain:.1f} e-, configured {camera.read_noise:g}"
        findings.append(
            Finding("camera", "noisy", text, "check `gain` and `read_noise`, and cool the camera")
        )
    values = {"level": level, "noise_counts": noise, "read_noise": noise * camera.gain, "hot_pixels": hot}
    changes = {"camera": {"read_noise": round(noise * camera.gain, 2)}} if noise and not findings else {}
    return Outcome(findings, values | {"sources": sources}, changes, {}, {"dark": frames[-1]})


def _frozen(frames: Sequence[Frame]) -> list[Finding]:
    """Return the finding about a camera that repeats a frame, if it does."""
    if frames[-1].sequence > frames[-2].sequence:
        return []
    text = f"frame {frames[-1].sequence} arrives again"
    return [Finding("camera", "frozen", text, "switch the camera off and on")]


def step_light(session: Session) -> Outcome:
    """Take the first light: a frame without the cap, which must differ from a dark frame."""
    session.device("camera")
    session.ask("Take the cap off, and point the camera at stars or at small lamps in the dark.")
    frames = [session.frame() for _ in range(2)]
    camera, pixels = session.config.camera, frames[-1].pixels
    assert camera is not None, "the device is open"
    sources, level = len(detect(pixels).stars()), float(np.median(pixels))
    saturation = camera.saturation or float(2**camera.bits - 1)
    saturated = float(np.mean(pixels >= saturation))
    findings = _frozen(frames)
    if pixels.shape != (camera.rows, camera.columns):
        size = f"{pixels.shape[1]} x {pixels.shape[0]} pixels instead of {camera.columns} x {camera.rows}"
        findings.append(Finding("camera", "wrong size", size, "correct `columns` and `rows`"))
    if saturated > 0.2:
        text = f"{100.0 * saturated:.0f} % of the pixels are saturated"
        findings.append(Finding("camera", "too bright", text, "shorten `exposure`, or darken the room"))
    elif sources < _FEW_SOURCES:
        findings.append(_no_light(session.known.get("dark"), pixels, level, sources))
    values = {"level": level, "sources": sources, "saturated": saturated, "sequence": frames[1].sequence}
    return Outcome(findings, values, {}, {}, {"light": pixels})


def _no_light(dark: Outcome | None, pixels: Image, level: float, sources: int) -> Finding:
    """Return the finding about a frame without point sources: the cap, or an unknown cause."""
    before = {} if dark is None else dark.values
    same = abs(level - before.get("level", math.inf)) <= 3.0 * max(before.get("noise_counts", 0.0), 1.0)
    if pixels.max() == pixels.min() > 0:
        text = f"every pixel has {level:.0f} counts"
        return Finding("camera", "no signal", text, "check sensor, cable, gain and `pixel_format`")
    if same or dark is None:
        text = f"{sources} point sources, and the level of a dark frame ({level:.0f} counts)"
        return Finding("camera", "lens cap on", text, "take the cap off, or point the camera at stars")
    text = f"{sources} point sources at a level of {level:.0f} counts, {UNRECOGNISED}"
    return Finding("camera", "no sources", text, "focus the lens, and point the camera at stars or lamps")


def step_focus(session: Session) -> Outcome:
    """Measure the width of the stars' images, repeatedly while somebody turns the focus ring."""
    session.device("camera")
    session.ask("Turn the focus ring until the PSF width is smallest.")
    widths: list[float] = []
    best: tuple[float, Image] | None = None
    while len(widths) < _FRAMES or session.live is not None:
        pixels = session.frame().pixels
        found = detect(pixels)
        width = found.psf_sigma if len(found) >= _FEW_SOURCES else math.nan
        widths.append(width)
        if math.isfinite(width) and (best is None or width <= best[0]):
            best = width, pixels
        if session.live is not None and not session.live(f"PSF width {width:.2f} px, {len(found)} sources"):
            break
    if best is None:
        raise StepSkipped(f"fewer than {_FEW_SOURCES} stars in each frame")
    last = next(width for width in reversed(widths) if math.isfinite(width))
    findings = []
    if not _SHARP[0] <= last <= _SHARP[1]:
        text = f"PSF width {last:.2f} px, good are {_SHARP[0]} to {_SHARP[1]} px"
        findings.append(Finding("camera", "out of focus", text, "turn the focus ring, and lock it"))
    values = {"psf_sigma": last, "widths": [None if math.isnan(width) else width for width in widths]}
    changes = {} if findings else {"camera": {"psf_sigma": round(last, 3)}}
    return Outcome(findings, values, changes, {"widths": np.array(widths)}, {"focus": best[1]})


def step_lens(session: Session) -> Outcome:
    """Calibrate the lens from frames of the sky in different directions."""
    camera = session.config.camera
    frames = []
    for number in range(_LENS_FRAMES):
        if session.hand is not None:
            session.hand.turn(np.array([0.6, 0.8, 0.0]), 0.15 * number, 0.001)
        session.ask(f"Point the camera at another part of the sky (frame {number + 1} of {_LENS_FRAMES}).")
        session.wait(0.1)
        frames.append(session.frame().pixels)
    assert camera is not None, "the device is open"
    found = calibrate_lens(frames, fov_deg=camera.field_of_view_deg)
    lens = found.determined
    if lens is None:
        raise StepSkipped(f"no frame could be solved: {found.images[0].reason}")
    calibration = lens.calibration
    findings = []
    field_deg = 2.0 * math.degrees(math.atan(0.5 * camera.columns / calibration.lens.focal_length))
    if abs(field_deg / camera.field_of_view_deg - 1.0) > 0.02:
        text = f"{field_deg:.3f} deg across the columns, configured {camera.field_of_view_deg:g}"
        findings.append(Finding("camera", "wrong field of view", text, "use the fragment's `camera`"))
    if found.mirrored:
        text = "the frames are mirrored"
        findings.append(
            Finding("camera", "mirrored", text, "correct the order of the rows, or remove the mirror")
        )
    values = {"stars": calibration.stars, "rms_px": calibration.rms_after, "field_of_view_deg": field_deg}
    changes: dict[str, Any] = {}
    if calibration.stars >= MIN_STARS and "focal_length" not in calibration.undetermined:
        kept = {
            name: round(value, 8) if isinstance(value, float) else value
            for name, value in calibration.lens.to_mapping().items()
            if name in {"focal_length", "centre", "k1", "k2", "aspect", "shear", "p1", "p2"}
        }
        accuracy = {name: float(f"{value:.3g}") for name, value in lens.accuracy.items()}
        changes = {"camera": {"field_of_view_deg": round(field_deg, 6), "lens": kept, "accuracy": accuracy}}
    return Outcome(findings, values, changes)


STEPS: dict[str, Callable[[Session], Outcome]] = {
    "find": step_find,
    "rest": step_rest,
    "axes": step_axes,
    "coils": step_coils,
    "dark": step_dark,
    "light": step_light,
    "focus": step_focus,
    "lens": step_lens,
}
"""The steps in their order."""
