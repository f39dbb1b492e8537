"""The open devices of a bench session, and the outcome of a step.

The driver sets a coil to zero if its command is not repeated within 0.25 s. The guardian sets all coils to
zero if this process stops, and `Session.close` does so at the end of every session.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from flight.app.devices import open_camera
from flight.schema.devices import driver_of
from flight.schema.sections import Config
from ground.bringup.diagnosis import Finding, Samples
from hal.interfaces.devices import Frame, FrameSource, ImuReading, InertialUnit, TorqueCoils
from hal.interfaces.errors import DeviceError, NotResponding
from hal.interfaces.guardian import CoilGuardian
from hal.interfaces.wires import SECOND_NS, Rig
from knightcube.astro.arrays import FloatArray, Image

_POLL_NS = 25_000_000
_FRAME_PATIENCE_NS = 12 * SECOND_NS
_ATTEMPTS = 3
"""Number of attempts to open a device, so that the measurement can begin despite a loose contact."""
_LOST_FRAMES = 2  # number of additional triggers if a trigger yields no frame
_LATE_FRAME_S = 2.0  # longest time (s) from the end of an exposure to the arrival of the frame
STILL_S = 0.5
"""Time (s) in which a body that stands still is measured."""


class StepSkipped(Exception):
    """Raised if a step of the bring-up cannot be performed.

    The text states the reason. The attribute `finding` is the fault that prevents the step, or None.
    """

    def __init__(self, reason: str, finding: Finding | None = None) -> None:
        super().__init__(reason)
        self.finding = finding


@dataclass(slots=True)
class Outcome:
    """The result of a step.

    Attributes:
        findings: faults of the parts.
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
        stack: closes every device that was opened.
        ask: function that requests an action of the person at the bench and waits for its completion.
        hand: the emulated hand (`sim_hal.rig.EmulatedBench`), or None at a real bench.
        guardian: guardian of the coils, or None with emulated devices.
        coil_field: expected field of each coil (n, 3) at the magnetometer, T/A, body axes, or None if the
            configuration does not describe it.
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

    def device(self, key: str) -> Any:
        """Return the open device of a section, such as `gps`, `power.bus_monitor` or `wide_cameras[1]`.

        Raises StepSkipped if it is not configured or not found.
        """
        if key not in self._open:
            missing = [one for one in self.known.get("find", Outcome()).findings if one.part == key]
            if missing:
                raise StepSkipped(f"{key} was not found ({missing[0].kind})")
            kind, section = self.section(key)
            if section is None:
                raise StepSkipped(f"the configuration has no {key}")
            for attempt in range(_ATTEMPTS):
                try:
                    self._open[key] = self._opened(key, kind, section)
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
            return "power_monitor", None if self.config.power is None else self.config.power.monitors().get(
                key
            )
        return key, getattr(self.config, key)

    def _opened(self, key: str, kind: str, section: Any) -> Any:
        if kind == "camera":
            if self.rig.cameras is not None:
                return self.rig.cameras[0 if key == kind else 1 + int(key[13:-1])]
            return open_camera(section, self.rig, self.stack)
        device = driver_of(kind, section, f"{key}.driver").open(self.rig, section)
        self.stack.callback(device.close)
        if kind == "coils":
            cast(TorqueCoils, device).start()
        if kind == "inertial_unit":
            cast(InertialUnit, device).configure()
            self.wait(STILL_S)
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
        """Return the frame of one trigger. Raises NotResponding."""
        clock = self.rig.clock
        source.trigger(round(exposure * SECOND_NS))
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
