"""The services that all tasks of the loop share, and the devices."""

from __future__ import annotations

from dataclasses import dataclass

from flight.link.telemetry.log import Recorder
from flight.loop.executive.jobs import JobRunner
from flight.loop.fdir.facts import EventLog, Facts, Streams
from hal.interfaces.devices import (
    FrameSource,
    GpsReceiver,
    InertialUnit,
    PowerMonitor,
    SolarStrings,
    TorqueCoils,
)
from hal.interfaces.wires import Clock


@dataclass(frozen=True, slots=True)
class Devices:
    """The open devices; all but unit and coils are optional, those of an orbit come last."""

    unit: InertialUnit
    coils: TorqueCoils
    power: PowerMonitor | None
    camera: FrameSource | None
    gps: GpsReceiver | None = None
    strings: SolarStrings | None = None
    wide: tuple[FrameSource, ...] = ()


@dataclass(frozen=True, slots=True)
class Services:
    """The clock, the workers, the recorder, and the tables of events, facts and streams."""

    clock: Clock
    jobs: JobRunner
    recorder: Recorder
    events: EventLog
    facts: Facts
    streams: Streams
