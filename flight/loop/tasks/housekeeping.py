"""Housekeeping: records the counters of devices and loop once a second, and checks the flight log."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from flight.link import events
from flight.link.telemetry.definitions import HOUSEKEEPING
from flight.loop.body import Planner
from flight.loop.control_output import SteeringState
from flight.loop.executive.rate_group import Cycle
from flight.loop.fdir import facts
from flight.loop.services import Services
from flight.loop.tasks.imaging import Imaging
from flight.loop.tasks.navigation import Navigation
from hal.interfaces.devices import PowerMonitor, TorqueCoils
from hal.interfaces.readings import CoilState


@dataclass(frozen=True, slots=True)
class Watched:
    """The sources of housekeeping; `log_error` returns why the flight log fails, empty while it works."""

    navigation: Navigation
    planner: Planner
    imaging: Imaging | None
    coils: TorqueCoils
    power: PowerMonitor | None
    log_error: Callable[[], str]


class Housekeeping:
    """Writes the housekeeping packet."""

    def __init__(self, watched: Watched, services: Services) -> None:
        self._watched = watched
        self._recorder = services.recorder
        self._events = services.events
        self._facts = services.facts
        self._lost = 0

    def coils(self) -> CoilState:
        """Return the state of the coils."""
        return self._watched.coils.state()

    def run(self, cycle: Cycle, state: SteeringState) -> None:
        """Write the packet; `state` is that of the newest control cycle."""
        watched, now_ns = self._watched, cycle.start_ns
        error = watched.power.error() if watched.power else ""
        log_error = watched.log_error()
        text = log_error or "packets reach the disk again"
        self._facts.update(facts.LOG_FAULT, bool(log_error), now_ns, text)
        self.report_lost(now_ns)
        reading = watched.power.latest() if watched.power and not error else None
        link = watched.navigation.link()
        accepted, refused = watched.planner.counts()
        frames, streak_rates = watched.imaging.counts() if watched.imaging else (0, 0)
        self._recorder.record(
            HOUSEKEEPING,
            now_ns,
            state=int(state),
            imu_packets=link.packets,
            imu_bad_checksum=link.bad_checksum,
            imu_discarded_bytes=link.discarded_bytes,
            imu_out_of_range=link.out_of_range,
            imu_not_finite=link.not_finite,
            coil_faults=watched.coils.state().faults,
            coil_voltage=reading.voltage if reading else math.nan,
            coil_current=reading.current if reading else math.nan,
            coil_power=reading.power if reading else math.nan,
            plans_accepted=accepted,
            plans_refused=refused,
            frames=frames,
            streak_rates=streak_rates,
            events=self._events.count,
            records_lost=self._recorder.lost,
        )

    def report_lost(self, now_ns: int) -> None:
        """Report the records that were lost since the last call, with the newest reason."""
        lost = self._recorder.lost
        if lost != self._lost:
            text = f"{lost - self._lost} more, the newest: {self._recorder.lost_text}"
            self._lost = lost
            self._events.report(events.RECORD_LOST, now_ns, text)
