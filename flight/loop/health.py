"""The watch over the rooms, the rate groups and the workers, built when all of them are there."""

from __future__ import annotations

from collections.abc import Callable

from flight.app.composition.tasks import LoopRooms
from flight.app.composition.workers import worker_watches
from flight.loop.executive.rate_group import RateGroup
from flight.loop.fdir.health_watch import HealthRooms, HealthWatch
from flight.loop.fdir.progress import GroupsAndWorkers
from flight.loop.fdir.resources import ClockWatch, ResourceMonitor
from flight.loop.services import Surroundings
from flight.schema.sections import Config


def health_watch(
    config: Config,
    around: Surroundings,
    rooms: LoopRooms,
    groups: list[RateGroup],
    feed: Callable[[], None],
) -> HealthWatch:
    """Return the task of health; `groups` begin with control, and `feed` is called while all get on."""
    watched = HealthRooms(
        rooms.modes,
        around.streams,
        around.facts,
        rooms.drive,
        around.devices.power,
        groups[0],
        GroupsAndWorkers(groups, worker_watches(config.executive, rooms.planning, rooms.imaging)),
        around.clock,
    )
    clock_watch = ClockWatch(around.clock, config.health.clock_step)
    return HealthWatch(
        watched, ResourceMonitor(config.health), clock_watch, around.recorder, around.events, feed
    )
