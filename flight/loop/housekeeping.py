"""Housekeeping: once a second the health of devices and loop, as packets and as events when it changes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from flight.bodies.testbed.planning import Planning
from flight.bodies.testbed.steering import Steering
from flight.link.telemetry.definitions import HOUSEKEEPING
from flight.link.telemetry.recorder import Recorder
from flight.loop.executive.rate_group import Cycle
from flight.loop.fdir import facts
from flight.loop.fdir.event_log import EventLog
from flight.loop.fdir.facts import Facts
from flight.loop.imaging import Imaging
from flight.loop.navigation import Navigation
from hal.interfaces.devices import PowerMonitor, TorqueCoils


@dataclass(frozen=True, slots=True)
class Watched:
    """What housekeeping looks at; `log_error` tells what is wrong with the flight log, empty when nothing."""

    navigation: Navigation
    steering: Steering
    planning: Planning
    imaging: Imaging | None
    coils: TorqueCoils
    power: PowerMonitor | None
    log_error: Callable[[], str]


class Housekeeping:
    """The 1 Hz task."""

    def __init__(self, watched: Watched, recorder: Recorder, event_log: EventLog, facts_: Facts) -> None:
        self._watched = watched
        self._recorder = recorder
        self._events = event_log
        self._facts = facts_

    def run(self, cycle: Cycle) -> None:
        """Write the housekeeping packet."""
        watched, now_ns = self._watched, cycle.start_ns
        error = watched.power.error() if watched.power else ""
        log_error = watched.log_error()
        text = log_error or "packets reach the disk again"
        self._facts.state(facts.LOG_FAULT, bool(log_error), now_ns, text)
        reading = watched.power.latest() if watched.power and not error else None
        link = watched.navigation.link()
        imaging = watched.imaging
        self._recorder.record(
            HOUSEKEEPING,
            now_ns,
            state=int(watched.steering.state),
            imu_packets=link.packets,
            imu_bad_checksum=link.bad_checksum,
            imu_discarded_bytes=link.discarded_bytes,
            imu_out_of_range=link.out_of_range,
            imu_not_finite=link.not_finite,
            coil_faults=watched.coils.state().faults,
            coil_voltage=reading.voltage if reading else math.nan,
            coil_current=reading.current if reading else math.nan,
            coil_power=reading.power if reading else math.nan,
            plans_accepted=watched.planning.accepted,
            plans_refused=watched.planning.refused,
            frames=imaging.frames if imaging else 0,
            streak_rates=imaging.accepted if imaging else 0,
            events=self._events.count,
        )
