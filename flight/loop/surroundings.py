"""What every room of the loop has around it."""

from __future__ import annotations

from dataclasses import dataclass

from flight.events import EventLog
from flight.executive.jobs import JobRunner
from flight.health.facts import Facts
from flight.health.streams import Streams
from flight.telemetry.recorder import Recorder
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
