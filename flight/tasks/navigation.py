"""Navigation: the inertial unit's samples and the rates from streaks into one estimate, or into none.

It also watches the unit's line and tells silence from corruption: bytes that stand still are silence, bytes
that make no packets are corruption, packets with impossible values are implausible.
"""

from __future__ import annotations

from dataclasses import dataclass

from flight import events
from flight.estimation.single_axis import ANGLE, RATE, Estimate, Measurement, SingleAxisFilter
from flight.events import Condition, EventLog
from flight.quaternion import angle_about_axis_y
from flight.telemetry.definitions import IMU
from flight.telemetry.recorder import Recorder
from hal.interfaces.devices import InertialUnit
from hal.interfaces.errors import DeviceError
from hal.interfaces.readings import ImuLink, ImuReading


@dataclass(frozen=True, slots=True)
class NavigationSettings:
    """Standard deviations of the unit's angle (rad) and rate (rad/s); age in ns past which all is lost."""

    angle_noise: float
    rate_noise: float
    max_age_ns: int


class Navigation:
    """Owns the filter and the watch over the inertial unit's line."""

    def __init__(
        self,
        unit: InertialUnit,
        filter_: SingleAxisFilter,
        settings: NavigationSettings,
        recorder: Recorder,
        event_log: EventLog,
    ) -> None:
        self._unit = unit
        self._filter = filter_
        self._settings = settings
        self._recorder = recorder
        self._events = event_log
        self._since_ns = 0
        self._last_good_ns = 0
        self._link = unit.link()
        self._heard_since_ns = 0
        self._silent = Condition(event_log, events.IMU_SILENT, events.IMU_RECOVERED)
        self._unusable = Condition(event_log, events.IMU_UNUSABLE, events.IMU_RECOVERED)
        self._lost = Condition(event_log, events.IMU_LINE_LOST, events.IMU_RECOVERED)

    def begin(self, time_ns: int) -> None:
        """Use samples from `time_ns` on only: the body is released then."""
        self._since_ns = time_ns
        self._last_good_ns = time_ns
        self._heard_since_ns = time_ns
        self._link = self._unit.link()

    def link(self) -> ImuLink:
        """Return the unit's counters."""
        return self._link

    def commanded(self, time_ns: int, current: float) -> None:
        """Tell the filter which current is in force about the thread from `time_ns` on."""
        self._filter.command(time_ns, current)

    def update(self, now_ns: int) -> None:
        """Take in what the unit has sent."""
        try:
            readings = self._unit.poll()
        except DeviceError as error:
            self._lost.update(True, now_ns, str(error))
            return
        self._lost.update(False, now_ns, "the serial port is back")
        for reading in readings:
            if reading.time_ns >= self._since_ns:
                self._take(reading)
                self._last_good_ns = now_ns
        self._watch_line(now_ns)

    def estimate(self, now_ns: int) -> Estimate | None:
        """Return the estimate for now, None when there is none to be trusted."""
        if not self._filter.started:
            return None
        estimate = self._filter.at(now_ns)
        return estimate if now_ns - estimate.measured_ns <= self._settings.max_age_ns else None

    def past_rate(self, time_ns: int) -> tuple[float, float] | None:
        """Return the rate about the thread at a past time and its standard deviation."""
        past = self._filter.past(time_ns)
        return None if past is None else (past.rate, float(past.covariance[RATE, RATE]) ** 0.5)

    def take_mean_rate(self, since_ns: int, until_ns: int, rate: float, variance: float) -> bool:
        """Put the mean rate over an exposure where it belongs in time; tell whether it passed the gate."""
        return self._filter.started and self._filter.measure(
            Measurement(until_ns, RATE, rate, variance, since_ns)
        )

    def _take(self, reading: ImuReading) -> None:
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
        angle = Measurement(
            reading.time_ns, ANGLE, angle_about_axis_y(reading.quaternion), self._settings.angle_noise**2
        )
        rate = Measurement(reading.time_ns, RATE, float(reading.rate[1]), self._settings.rate_noise**2)
        if not self._filter.started:
            self._filter.start(angle, rate)
            return
        agreed = self._filter.measure(angle) and self._filter.started and self._filter.measure(rate)
        if not agreed:
            self._events.tell(
                events.IMU_REFUSED,
                reading.arrival_ns,
                f"angle {angle.value:.4f} rad, rate {rate.value:.5f} rad/s disagree with the estimate",
            )

    def _watch_line(self, now_ns: int) -> None:
        link, before = self._unit.link(), self._link
        self._link = link
        limit_ns = self._settings.max_age_ns
        quiet_ns = now_ns - max(link.last_byte_ns, self._since_ns)
        silent = quiet_ns > limit_ns
        text = f"no byte for {quiet_ns * 1e-9:.2f} s" if silent else "bytes come again"
        self._silent.update(silent, now_ns, text)
        if silent:
            self._heard_since_ns = now_ns
        without_ns = now_ns - max(self._last_good_ns, self._heard_since_ns)
        unusable = without_ns > limit_ns
        text = f"no reading in {without_ns * 1e-9:.2f} s of bytes: has the unit started anew?"
        self._unusable.update(unusable, now_ns, text if unusable else "readings come again")
        bad = link.bad_checksum - before.bad_checksum
        stray = link.discarded_bytes - before.discarded_bytes
        if bad or stray:
            text = f"{bad} packets with a wrong checksum, {stray} bytes of no packet"
            self._events.tell(events.IMU_CORRUPT, now_ns, text)
        odd = link.out_of_range - before.out_of_range
        endless = link.not_finite - before.not_finite
        if odd or endless:
            text = f"{odd} packets out of range, {endless} not finite"
            self._events.tell(events.IMU_IMPLAUSIBLE, now_ns, text)
