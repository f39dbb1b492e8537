"""Navigation: passes readings of inertial unit, GPS, solar cells and horizon cameras to the filter.

The serial line of the inertial unit is monitored for silence (no bytes), corruption (bytes without valid
packets) and implausible values. Rates from streaks and attitudes from stars update the estimate at the times
of their measurement. The filter propagates with the coil currents, which are unknown (`CoilKnowledge`) while
the PWM driver fails, after the loop has stalled, and while the supply current contradicts the commands.

All horizon cameras are triggered together, more often while the body needs their frames. A camera is reported
if it delivers no frame, repeats an image, or delivers images that contradict a fine attitude. The task runs
once a second, or ten times a second for cameras with a `period` or `fine_period` below 2 s, independently of
the control cycle. A frame is a measurement at the time of its exposure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flight.link import events
from flight.link.telemetry.definitions import DIRECTIONS, FIX, GPS_LINK, IMU
from flight.loop import facts
from flight.loop.body import BodyEstimation, FixVerdict, HorizonCameraUse
from flight.loop.coil_response import CoilCorrection
from flight.loop.executive import JobResult
from flight.loop.facts import Services
from hal.interfaces.devices import (
    CoilState,
    Frame,
    FrameSource,
    GpsLink,
    GpsReading,
    GpsReceiver,
    ImuLink,
    ImuReading,
    InertialUnit,
    SolarStrings,
    StringReading,
)
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.gnc.estimation.estimate import AttitudeMeasurement, Estimate, Measurement
from knightcube.vision.horizon_camera_job import HorizonCameraResult

_AT_A_TIME = 16
"""Number of filter updates that one control cycle repeats after a late measurement. These updates take a few
ms, so that the updates of one second are repeated within a few control cycles."""


@dataclass(frozen=True, slots=True)
class NavigationSettings:
    """Age limits of the inertial unit's readings.

    Attributes:
        max_age_ns: largest age (ns) of a reading that is used to drive the coils.
        coast_ns: longest propagation (ns) of the estimate without measurements; such an estimate is used for
            telemetry only.
        period_ns: period (ns) of the control cycle, during which a commanded current flows.
        has_gyro: whether the unit measures the rate; if so, a reading without a rate is a fault.
    """

    max_age_ns: int
    coast_ns: int
    period_ns: int
    has_gyro: bool = True


_UNSEEN_NS = 600_000_000
"""Longest time (ns) from a PWM error to its detection; the driver reads its outputs back twice a second."""
_UNSUSPECTED_NS = 800_000_000
"""Longest time (ns) from a coil fault to its suspicion, which needs four readings of the current monitor."""
STOOD_NS = 200_000_000
"""Stall of the control loop (ns) after which the guardian may have set the coils to zero."""


class CurrentValidity(NamedTuple):
    """Validity of the recorded coil currents.

    Attributes:
        now: whether the present currents are known.
        since_last_look: whether the PWM chip kept all commands since the previous call.
        since_ns: time (ns) since which the currents have been known.
        uncertain_since_ns: time (ns) since which currents recorded as known are uncertain, or None.
    """

    now: bool
    since_last_look: bool
    since_ns: int
    uncertain_since_ns: int | None


class CoilKnowledge:
    """Determines once a cycle whether the coil currents are known."""

    def __init__(self) -> None:
        self._obeys = True
        self._suspected = False
        self._since_ns = -1
        self._looked_ns: int | None = None

    def look(self, in_force: CoilState, now_ns: int, *, suspected: bool = False) -> CurrentValidity:
        """Derive from the driver's state and the time since the last call which currents are known.

        If the supply current contradicts a healthy coil circuit (`suspected`), a coil may carry any current.
        """
        obeyed, self._obeys = self._obeys, not in_force.error
        was_suspected, self._suspected = self._suspected, suspected
        looked_ns, self._looked_ns = self._looked_ns, now_ns
        stood = looked_ns is not None and now_ns - looked_ns > STOOD_NS
        since_last_look = obeyed and self._obeys and not stood
        now = self._obeys and not suspected
        if now and (was_suspected or not since_last_look):
            self._since_ns = now_ns
        uncertain = [now_ns - _UNSEEN_NS] if obeyed and not self._obeys else []
        if suspected and not was_suspected:
            uncertain.append(now_ns - _UNSUSPECTED_NS)
        if looked_ns is not None and stood:
            uncertain.append(looked_ns)
        return CurrentValidity(now, since_last_look, self._since_ns, min(uncertain, default=None))


class Navigation:
    """Holds the filter, and monitors the serial line of the inertial unit."""

    def __init__(
        self,
        unit: InertialUnit,
        estimation: BodyEstimation,
        settings: NavigationSettings,
        services: Services,
        magnetometer: InertialUnit | None = None,
    ) -> None:
        """Read the inertial unit or, while it gives no readings, the `magnetometer`."""
        self._unit, self._magnetometer = unit, magnetometer
        self._thinned = False  # whether only the newest reading of a cycle is used
        self._replaced = False  # whether the magnetometer replaces the inertial unit
        self._unit_ns = 0  # time (ns) of the unit's newest reading
        self._estimation = estimation
        self._filter = estimation.filter
        self._feed = estimation.feed
        self._settings, self._recorder, self._events = settings, services.recorder, services.events
        self._facts, self._streams = services.facts, services.streams
        self._since_ns = 0
        self._received_ns = 0  # time (ns) of the newest reading
        self._agreed_ns = 0
        self._link = unit.link()
        self._bytes_since_ns = 0
        self._doubted = False
        self._coil_factors = estimation.coil_monitor.correction.factors
        self._available = estimation.coil_monitor.available
        self._has_rate = True
        self._gyro_rate = np.zeros(3)
        self.speed = 0.0
        """Body rate (rad/s) of the newest gyro reading, corrected for the estimated gyro bias. If the gyro
        gives no rate, the value is the rate of the estimate, or else the largest likely rate from the
        magnetometer, or infinity while the rate is unknown."""

    def begin(self, time_ns: int) -> None:
        """Ignore readings made before the release of the body at `time_ns`."""
        self._since_ns = time_ns
        self._received_ns = self._agreed_ns = self._unit_ns = time_ns
        self._bytes_since_ns = time_ns
        self._link = self._unit.link()

    def link(self) -> ImuLink:
        """Return the counters of the inertial unit's serial line."""
        return self._link

    def correct_coils(self, correction: CoilCorrection, available: BoolArray) -> None:
        """Pass a change of the coils' signs and gains, and of the available coils (n,), to the estimation."""
        if available is not self._available:
            before, self._available = self._available, available
            if not np.array_equal(before, available):
                self._estimation.coils_used(available)
        if correction.factors is not self._coil_factors:
            change, self._coil_factors = correction.factors / self._coil_factors, correction.factors
            self._estimation.coils_corrected(change, correction.deviations)

    def commanded(self, in_force: CoilState, currents: FloatArray, known: CurrentValidity) -> None:
        """Pass the effective coil currents (n,), A, and whether they are known, to the filter."""
        if known.uncertain_since_ns is not None:
            self._filter.mark_unknown(known.uncertain_since_ns)
        self._filter.command(max(in_force.written_ns, known.since_ns), currents, known=known.now)

    def thin(self, thinned: bool) -> None:
        """Use only the newest reading of each control cycle if `thinned` is true, because of an overload."""
        self._thinned = thinned

    def update(self, now_ns: int) -> tuple[ImuReading, ...]:
        """Apply new and late measurements, and return the readings of this cycle, oldest first."""
        self._filter.catch_up(_AT_A_TIME)
        try:
            polled = self._unit.poll()
        except DeviceError as error:
            self._facts.update(facts.IMU_LINE_LOST, True, now_ns, str(error))
            if self._magnetometer is None:
                return ()
            polled = []
        else:
            self._facts.update(facts.IMU_LINE_LOST, False, now_ns, "the serial port is back")
        if self._magnetometer is not None:
            polled = self._or_magnetometer(polled, self._magnetometer, now_ns)
        readings = tuple(reading for reading in polled if self._is_usable(reading, now_ns))
        used = readings[-1:] if self._thinned else readings
        for reading in used:
            self._ingest(reading)
        for reading in readings:
            self._streams.note("imu", reading.time_ns)
            self._streams.note("field", reading.time_ns, math.hypot(*reading.field.tolist()))
            self._received_ns = reading.time_ns
            self._has_rate = reading.has_rate
            if reading.has_rate:
                self._gyro_rate, self.speed = reading.rate, math.hypot(*reading.rate.tolist())
        self._watch_line(now_ns)
        doubted = self._filter.doubts_commands
        if doubted and not self._doubted:
            self._estimation.coil_monitor.test_soon()
        self._doubted = doubted
        text = "contradicts the commands" if doubted else "agrees with the commands again"
        self._facts.update(facts.COMMANDS_DOUBTED, doubted, now_ns, f"the body rate {text}")
        return used

    def _or_magnetometer(
        self, polled: list[ImuReading], magnetometer: InertialUnit, now_ns: int
    ) -> list[ImuReading]:
        """Return the inertial unit's readings or, if these are too old, the magnetometer's readings."""
        if polled:
            self._unit_ns = polled[-1].time_ns
        fields: list[ImuReading] = []
        with suppress(DeviceError):  # other conditions report a failed magnetometer
            fields = magnetometer.poll()
        replaced = now_ns - self._unit_ns > self._settings.max_age_ns
        if replaced is not self._replaced:
            self._replaced = replaced
            self._estimation.magnetometer_changed()
        return [one for one in fields if one.time_ns > self._received_ns] if replaced else polled

    def is_current(self, now_ns: int) -> bool:
        """Return whether the newest reading will be recent enough for control until the next cycle."""
        return self._is_fresh(self._received_ns, now_ns)

    def is_measured(self, estimate: Estimate | None, now_ns: int) -> bool:
        """Return whether the estimate will be accurate enough for driving the coils until the next cycle.

        The newest reading that agreed with the estimate must stay within its age limit until the next cycle.
        An estimate that is only propagated by the model is recorded, but not used for steering. Without a
        gyro, the estimate must also satisfy the body's accuracy limits (`is_accurate`).
        """
        return self.is_accurate(estimate) and self._is_fresh(self._agreed_ns, now_ns)

    def is_accurate(self, estimate: Estimate | None) -> bool:
        """Return whether there is an estimate; if the gyro gives no rate, it must also be accurate enough."""
        return estimate is not None and (self._has_rate or self._estimation.is_accurate(estimate))

    def _is_usable(self, reading: ImuReading, now_ns: int) -> bool:
        """Return whether the filter can use a reading; a reading that has no valid rate is reported."""
        if reading.time_ns < self._since_ns:
            return False
        text = "the rate is valid again"
        if not reading.has_rate:
            text = f"invalid: {self._unit.link().rejection}"
            text = "the magnetometer replaces the silent inertial unit" if self._replaced else text
        lost = self._settings.has_gyro and not reading.has_rate
        self._facts.update(facts.GYRO_LOST, lost, now_ns, text)
        return reading.has_rate or self._estimation.uses_readings_without_rate

    def _is_fresh(self, time_ns: int, now_ns: int) -> bool:
        return now_ns + self._settings.period_ns - time_ns < self._settings.max_age_ns

    def estimate(self, now_ns: int) -> Estimate | None:
        """Return the present estimate, measured or propagated by the model, or None if there is none."""
        # During a long silence, the propagated estimate becomes inaccurate and slow to compute.
        if not self._filter.started or now_ns - self._filter.measured_ns > self._settings.coast_ns:
            self.speed = self.speed if self._has_rate else self._estimation.fastest_by_field()
            return None
        estimate = self._filter.at(now_ns)
        rate = self._gyro_rate - estimate.bias if self._has_rate else estimate.rate
        self.speed = math.hypot(*rate.tolist())
        return estimate

    def past(self, time_ns: int) -> Estimate | None:
        """Return the estimate at a past time, or None if the time is before the filter's history."""
        return self._filter.past(time_ns) if self._filter.started else None

    def rates(self, begin_ns: int, end_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Return the times (n,), ns, and rates (n, 3), rad/s, of a past interval.

        Returns None if the interval begins before the filter's history.
        """
        return self._filter.rates(begin_ns, end_ns) if self._filter.started else None

    def begin_from(self, attitude: AttitudeMeasurement) -> bool:
        """If the filter has no estimate, start it from a star fix; return whether it started."""
        return not self._filter.started and self._feed.begin(attitude)

    def ingest_late(self, late: Sequence[Measurement], report: Callable[[list[bool]], None]) -> None:
        """Apply measurements of a frame, at once or over the next cycles.

        The function `report` receives one flag for each measurement: whether the measurement was accepted.
        """
        if self._filter.started:
            self._filter.measure_late(late, report)
        else:
            report([False] * len(late))

    def _ingest(self, reading: ImuReading) -> None:
        self._recorder.record(
            IMU,
            reading.arrival_ns,
            sample_time_ns=reading.time_ns - self._recorder.epoch_ns,
            device_time_ns=reading.device_time_ns,
            quaternion=reading.quaternion.tolist(),
            rate=reading.rate.tolist(),
            field=reading.field.tolist(),
            acceleration=reading.acceleration.tolist(),
        )
        agreement = self._feed.accept(reading)
        if agreement.holds:
            self._agreed_ns = reading.time_ns
        if agreement.objection:
            text = f"{agreement.objection} disagrees with the estimate"
            self._events.report(events.IMU_REFUSED, reading.arrival_ns, text)

    def _watch_line(self, now_ns: int) -> None:
        link, before = self._unit.link(), self._link
        self._link = link
        limit_ns = self._settings.max_age_ns
        quiet_ns = now_ns - max(link.last_byte_ns, self._since_ns)
        silent = quiet_ns > limit_ns
        text = f"no byte for {quiet_ns * 1e-9:.2f} s" if silent else "bytes arrive again"
        self._facts.update(facts.IMU_SILENT, silent, now_ns, text)
        if silent:
            self._bytes_since_ns = now_ns
        without_ns = now_ns - max(self._received_ns, self._bytes_since_ns)
        unusable = without_ns > limit_ns
        text = "readings arrive again"
        if unusable:
            text = f"bytes but no reading for {without_ns * 1e-9:.2f} s: the unit may have restarted"
        self._facts.update(facts.IMU_UNUSABLE, unusable, now_ns, text)
        bad = link.bad_checksum - before.bad_checksum
        stray = link.discarded_bytes - before.discarded_bytes
        if bad or stray:
            text = f"{bad} packets with a wrong checksum, {stray} bytes outside packets"
            self._events.report(events.IMU_CORRUPT, now_ns, text)
        odd = link.out_of_range - before.out_of_range
        endless = link.not_finite - before.not_finite
        if (odd or endless) and not self._facts.holds(facts.GYRO_LOST):
            text = f"{odd} packets out of range, {endless} not finite: {link.rejection}"
            self._events.report(events.IMU_IMPLAUSIBLE, now_ns, text)
        if link.upsets > before.upsets:
            self._events.report(events.IMU_UPSET, now_ns, link.upset)


GPS_DELAY_NS = 100_000_000
"""Delay (ns) from the time of a GPS fix to the first byte of the receiver's report; at most 0.2 s."""
FIX_PERIOD_NS = 10 * SECOND_NS
"""Shortest time (ns) between two recorded fixes, and between two records of the serial line's counters."""
_COUNTERS = tuple(field.name for field in GPS_LINK.fields)
_RECORDED = ("utc_ns", "position", "velocity", "sigma", "velocity_sigma", "satellites")


class Positioning:
    """Reads the GPS receiver, and passes its fixes to the body."""

    def __init__(
        self,
        receiver: GpsReceiver,
        accept: Callable[[GpsReading], FixVerdict],
        max_age_ns: int,
        services: Services,
    ) -> None:
        """Pass fixes to `accept`; report the receiver as lost after `max_age_ns` without a fix."""
        self._receiver, self._accept, self._max_age_ns = receiver, accept, max_age_ns
        self._events, self._facts, self._streams = services.events, services.facts, services.streams
        self._clock, self._recorder = services.clock, services.recorder
        self._fixed_ns = 0
        self._off_ns: int | None = None
        self._recorded_ns: int | None = None
        self._link = receiver.link()
        self._link_recorded_ns: int | None = None

    def begin(self, time_ns: int) -> None:
        """Until the first fix arrives, measure the age of the newest fix from `time_ns`."""
        self._fixed_ns = time_ns

    def run(self, now_ns: int) -> None:
        """Accept the fixes that have arrived since the last call."""
        error = ""
        try:
            readings = self._receiver.poll()
        except DeviceError as lost:
            readings, error = [], str(lost)
        for reading in readings:
            if not reading.valid:
                continue
            self._streams.note("gps", reading.time_ns)
            verdict = self._accept(reading)
            if verdict.used:
                self._fixed_ns = reading.time_ns
                # Before the first fix, the position was computed with the wall clock.
                self._off_ns = self._clock.correct(reading.utc_ns + GPS_DELAY_NS, reading.time_ns)
                text = f"the wall clock differs from GPS time by {self._off_ns * 1e-9:+.1f} s"
                self._facts.update(facts.CLOCK_OFF, abs(self._off_ns) > facts.CLOCK_OFF_NS, now_ns, text)
            elif verdict.refusal:
                text = f"{verdict.refusal}; {reading.satellites} satellites"
                self._events.report(events.GPS_REFUSED, now_ns, text)
            self._record(reading, verdict.used, now_ns)
        link = self._watch_line(now_ns)
        age_ns = now_ns - self._fixed_ns
        cause = f": {link.condition}" if link.condition else ""
        text = error or f"no usable fix for {age_ns * 1e-9:.0f} s{cause}"
        lost_now = bool(error) or age_ns > self._max_age_ns
        self._facts.update(facts.GPS_LOST, lost_now, now_ns, text if lost_now else "fixes arrive again")

    def _watch_line(self, now_ns: int) -> GpsLink:
        """Record the counters of the serial line, report the problems that they indicate, and return them."""
        link, before = self._receiver.link(), self._link
        self._link = link
        if link.refused > before.refused:
            self._events.report(events.GPS_SET_UP, now_ns, link.refusal)
        odd = {
            "frames with a wrong checksum": link.bad_checksum - before.bad_checksum,
            "solutions out of range": link.out_of_range - before.out_of_range,
            "dates moved by 1024 weeks": int(link.rolled_over > 0 and before.rolled_over == 0),
        }
        if any(odd.values()):
            text = ", ".join(f"{count} {name}" for name, count in odd.items() if count)
            cause = f": {link.condition}" if link.condition else ""
            self._events.report(events.GPS_LINK, now_ns, text + cause)
        if self._link_recorded_ns is None or now_ns - self._link_recorded_ns >= FIX_PERIOD_NS:
            self._link_recorded_ns = now_ns
            counters = {name: getattr(link, name) for name in _COUNTERS}
            self._recorder.record(GPS_LINK, now_ns, **counters)
        return link

    def _record(self, reading: GpsReading, used: bool, now_ns: int) -> None:
        """Record a fix, unless the last recorded fix is too recent."""
        if self._recorded_ns is not None and reading.time_ns - self._recorded_ns < FIX_PERIOD_NS:
            return
        self._recorded_ns = reading.time_ns
        self._recorder.record(
            FIX,
            now_ns,
            **{name: getattr(reading, name) for name in _RECORDED},
            used=used,
            clock_off=math.nan if self._off_ns is None else self._off_ns * 1e-9,
        )


class SunSensing:
    """Reads the solar cells, and passes their currents to the body."""

    def __init__(
        self,
        strings: SolarStrings,
        accept: Callable[[StringReading], str | None],
        max_age_ns: int,
        services: Services,
    ) -> None:
        """`accept` is `BodyEstimation.accept_sun`; readings older than `max_age_ns` are not used."""
        self._strings, self._accept, self._max_age_ns = strings, accept, max_age_ns
        self._facts = services.facts
        self._read_ns = 0

    def begin(self, time_ns: int) -> None:
        """Until the first reading arrives, measure the age of the newest reading from `time_ns`."""
        self._read_ns = time_ns

    def run(self, now_ns: int) -> None:
        """Accept the newest reading once, unless one of its currents is not finite."""
        reading = self._strings.latest()
        if reading is not None and reading.time_ns > self._read_ns and np.isfinite(reading.currents).all():
            self._read_ns = reading.time_ns
            if now_ns - reading.time_ns <= self._max_age_ns:
                wrong = self._accept(reading)
                if wrong is not None:
                    self._facts.update(facts.SUN_UNCLEAR, bool(wrong), now_ns, wrong or "the Sun is detected")
        age_ns = now_ns - self._read_ns
        lost = age_ns > self._max_age_ns
        text = self._strings.error() or f"no reading for {age_ns * 1e-9:.0f} s"
        self._facts.update(facts.STRINGS_LOST, lost, now_ns, text if lost else "readings arrive again")


HORIZON_WORKER = "wide"
_SPARSE = 8
"""Spacing (px) of the pixels that are compared with the last image to detect repeated images."""
_NONE = [float("nan")] * 3


@dataclass(frozen=True, slots=True)
class HorizonCameraSettings:
    """Durations that the task of the horizon cameras uses, in ns.

    Attributes:
        exposures_ns: exposure time (ns) of each camera.
        period_ns: time (ns) between triggers while the body needs frames often.
        fine_period_ns: time (ns) between triggers while the attitude estimate is accurate (`Knowledge.FINE`).
        late_ns: longest time (ns) from a trigger to the arrival of a frame.
        max_age_ns: time (ns) without a frame after which a camera is reported as lost.
    """

    exposures_ns: Sequence[int]
    period_ns: int
    fine_period_ns: int
    late_ns: int
    max_age_ns: int


class HorizonCameraTask:
    """Triggers and monitors the horizon cameras, and collects the frames of a trigger."""

    def __init__(
        self,
        cameras: Sequence[FrameSource],
        sight: HorizonCameraUse,
        settings: HorizonCameraSettings,
        services: Services,
    ) -> None:
        self._cameras, self._sight, self._settings = cameras, sight, settings
        self._services = services
        self._triggered_ns = 0
        self._waits = False
        self._frames: dict[int, Frame] = {}
        self._seen_ns = [0] * len(cameras)
        self._sequences = [-1] * len(cameras)
        self._errors = [""] * len(cameras)
        self._pictures = [b""] * len(cameras)
        # The present job: start time of exposures (ns), bit mask of cameras, submission time (ns).
        self._job: tuple[int, int, int] | None = None

    def begin(self, time_ns: int) -> None:
        """Set the time of the first trigger; until frames arrive, their ages are measured from `time_ns`."""
        self._triggered_ns = time_ns - self._settings.fine_period_ns
        self._seen_ns = [time_ns] * len(self._cameras)

    def busy_since_ns(self) -> int | None:
        """Return the time (ns) at which the worker received its frames, or None while it is idle."""
        return None if self._job is None else self._job[2]

    def run(self, now_ns: int) -> None:
        """Collect the frames of the last trigger, submit them to the worker, and trigger again if due."""
        if self._waits:
            self._collect(now_ns)
        period_ns = self._settings.period_ns if self._sight.needed else self._settings.fine_period_ns
        if not self._waits and self._job is None and now_ns - self._triggered_ns >= period_ns:
            self._triggered_ns, self._waits = now_ns, True
            self._frames = {}
            for number, camera in enumerate(self._cameras):
                try:
                    camera.trigger(self._settings.exposures_ns[number])
                except DeviceError as error:
                    self._errors[number] = str(error)
        self._watch(now_ns)

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Accept the worker's result, and pass the directions to the body."""
        job, self._job = self._job, None
        if job is None:
            return
        if result.outcome != "done":
            text = f"wide cameras: {result.outcome}: {result.error}"
            self._services.events.report(events.VISION_FAILED, now_ns, text)
            return
        found: HorizonCameraResult = result.value
        if found.false is not None:
            # The worker had an attitude that was accurate enough to check the images.
            text = "all images agree with the attitude"
            if found.false:
                names = ", ".join(str(number + 1) for number in found.false)
                text = f"images of camera {names} contradict the attitude: {next(iter(found.false.values()))}"
            self._services.facts.update(facts.WIDE_FALSE, bool(found.false), now_ns, text)
        used = self._sight.accept(job[0], found)
        self._record(now_ns, job, found, used)

    def _collect(self, now_ns: int) -> None:
        for number, camera in enumerate(self._cameras):
            if number in self._frames:
                continue
            try:
                frame = camera.poll()
            except DeviceError as error:
                self._errors[number] = str(error)
                continue
            if frame is None or frame.sequence <= self._sequences[number]:
                continue  # a repeated frame does not count as a new frame
            self._sequences[number] = frame.sequence
            before = self._pictures[number]
            self._pictures[number] = frame.pixels[::_SPARSE, ::_SPARSE].tobytes()
            if self._pictures[number] == before:
                self._errors[number] = "it repeats its last image"
                continue
            if frame.exposure_start_ns < self._triggered_ns:
                continue  # the frame belongs to an earlier trigger
            self._frames[number], self._seen_ns[number], self._errors[number] = frame, now_ns, ""
        if len(self._frames) == len(self._cameras) or now_ns - self._triggered_ns >= self._settings.late_ns:
            self._waits = False
            frames, self._frames = self._frames, {}
            middles = [frame.exposure_start_ns + frame.exposure_ns // 2 for frame in frames.values()]
            if frames and self._services.jobs.submit(HORIZON_WORKER, self._sight.job(frames)):
                self._job = sum(middles) // len(middles), sum(1 << number for number in frames), now_ns
            elif frames:
                text = "wide cameras: the worker is busy or not running"
                self._services.events.report(events.VISION_FAILED, now_ns, text)

    def _watch(self, now_ns: int) -> None:
        """Report the cameras that have delivered no frame for longer than the limit."""
        limit_ns = self._settings.max_age_ns
        old = [number for number, seen in enumerate(self._seen_ns) if now_ns - seen > limit_ns]
        text = "frames arrive again"
        if old:
            error = next((self._errors[number] for number in old if self._errors[number]), "")
            names = ", ".join(str(number + 1) for number in old)
            text = f"no frame of camera {names} for {(now_ns - self._seen_ns[old[0]]) * 1e-9:.0f} s"
            text = f"{text}: {error}" if error else text
        self._services.facts.update(facts.WIDE_LOST, bool(old), now_ns, text)

    def _record(
        self, now_ns: int, job: tuple[int, int, int], found: HorizonCameraResult, used: tuple[bool, bool]
    ) -> None:
        sun, nadir, recorder = found.sun, found.nadir, self._services.recorder
        recorder.record(
            DIRECTIONS,
            now_ns,
            middle_ns=job[0] - recorder.epoch_ns,
            frames=job[1],
            sun=_NONE if sun is None else sun.direction.tolist(),
            sun_sigma=float("nan") if sun is None else sun.sigma,
            sun_cameras=0 if sun is None else sun.mask,
            sun_used=int(used[0]),
            nadir=_NONE if nadir is None else nadir.direction.tolist(),
            nadir_sigma=float("nan") if nadir is None else nadir.sigma,
            nadir_cameras=0 if nadir is None else nadir.mask,
            nadir_used=int(used[1]),
        )
