"""The watch over the rooms, the rate groups and the workers, built when all of them are there."""

from __future__ import annotations

from collections.abc import Callable

from flight.executive.rate_group import RateGroup
from flight.health.progress import GroupsAndWorkers
from flight.health.resources import ClockWatch, ResourceMonitor
from flight.loop.rooms import LoopRooms
from flight.loop.surroundings import Surroundings
from flight.settings import Config
from flight.tasks.health_watch import HealthRooms, HealthWatch
from flight.tasks.workers import worker_watches


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
