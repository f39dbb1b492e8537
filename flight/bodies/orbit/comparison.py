"""Attitude determination by the method of Meller et al., in parallel with the flight filter."""

from __future__ import annotations

import numpy as np

from flight.bodies.orbit.filter import OrbitFilter
from flight.link.telemetry.definitions import SEPARATE_ATTITUDES
from flight.loop.body import ReadingAgreement, ReadingFeed
from flight.loop.facts import Services
from flight.schema.orbit import OrbitConfig
from hal.interfaces.devices import ImuReading
from knightcube.astro.attitude.solvers import VectorObservation
from knightcube.gnc.estimation.estimate import ATTITUDE, AttitudeMeasurement
from knightcube.reference.sensor_fusion import GyroBiasFilter, KnownAttitude, SeparateDetermination


class ComparedFeed:
    """Passes readings to the flight filter and to the compared method; implements `ReadingFeed`."""

    def __init__(
        self, feed: ReadingFeed, filter_: OrbitFilter, config: OrbitConfig, services: Services
    ) -> None:
        unit, section = config.inertial_unit, config.estimation
        noise = unit.rate_noise / np.sqrt(unit.rate_hz)
        self._feed, self._filter, self._services = feed, filter_, services
        self._method = SeparateDetermination(GyroBiasFilter(noise, section.bias_start, section.bias_walk))

    def accept(self, reading: ImuReading) -> ReadingAgreement:
        """Pass a reading to both methods."""
        if reading.has_rate:
            self._method.gyro(reading.time_ns, reading.rate)
        return self._feed.accept(reading)

    def begin(self, attitude: AttitudeMeasurement) -> bool:
        """Start the flight filter from a star fix, which the compared method does not use."""
        return self._feed.begin(attitude)

    def compare(
        self,
        time_ns: int,
        sun: VectorObservation | None,
        nadir: VectorObservation | None,
        field: VectorObservation | None,
    ) -> None:
        """Determine the attitude at `time_ns` from the directions of the sensors, and record it."""
        found = self._method.update(time_ns, sun, nadir, field)
        past = self._filter.past(time_ns) if self._filter.runs else None
        flown = KnownAttitude()
        if past is not None:
            flown = KnownAttitude(past.quaternion, past.covariance[ATTITUDE, ATTITUDE])
        named = {
            "cameras": found.cameras,
            "magnetometer": found.magnetometer,
            "fused": found.fused,
            "filtered": found.filtered,
            "flown": flown,
        }
        values = {name: one.quaternion.tolist() for name, one in named.items()}
        sigmas = {f"{name}_sigma": one.sigma for name, one in named.items()}
        recorder = self._services.recorder
        recorder.record(
            SEPARATE_ATTITUDES,
            self._services.clock.now_ns(),
            middle_ns=time_ns - recorder.epoch_ns,
            gyro_bias=found.bias.tolist(),
            **values,
            **sigmas,
        )
