"""What every room of the loop has around it."""

from __future__ import annotations

from dataclasses import dataclass

from flight.link.telemetry.recorder import Recorder
from flight.loop.executive.jobs import JobRunner
from flight.loop.fdir.event_log import EventLog
from flight.loop.fdir.facts import Facts
from flight.loop.fdir.streams import Streams
from hal.interfaces.devices import FrameSource, InertialUnit, PowerMonitor, TorqueCoils
from hal.interfaces.wires import Clock


@dataclass(frozen=True, slots=True)
class Devices:
    """The open devices; a monitor and a camera are not everywhere fitted."""

    unit: InertialUnit
    coils: TorqueCoils
    power: PowerMonitor | None
    camera: FrameSource | None


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Clock, devices and workers from outside; the recorder, and what the rooms state and tell each other."""

    clock: Clock
    devices: Devices
    jobs: JobRunner
    recorder: Recorder
    events: EventLog
    facts: Facts
    streams: Streams
