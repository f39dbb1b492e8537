"""The rate groups of the loop, in order of importance."""

from __future__ import annotations

from dataclasses import dataclass

from flight.loop.executive.rate_group import RateGroup, Task
from flight.loop.tasks.performance import CONTROL
from hal.interfaces.wires import SECOND_NS

HEALTH_PERIOD_NS = SECOND_NS // 4
COMMAND_PERIOD_NS = SECOND_NS // 10


@dataclass(frozen=True, slots=True)
class Periods:
    """Periods from the configuration, ns; None for what is not done."""

    control_ns: int
    replan_ns: int | None
    camera_ns: int | None


@dataclass(frozen=True, slots=True)
class GroupTasks:
    """The task of each rate group; None where there is nothing to do."""

    control: Task
    replan: Task
    camera: Task | None
    commands: Task | None
    health: Task
    housekeeping: Task


def rate_groups(periods: Periods, tasks: GroupTasks) -> list[RateGroup]:
    """Return the rate groups, control first."""
    groups = [
        RateGroup(CONTROL, periods.control_ns, tasks.control),
    ]
    if periods.replan_ns is not None:
        groups.append(RateGroup("planning", periods.replan_ns, tasks.replan))
    if tasks.camera is not None and periods.camera_ns is not None:
        groups.append(RateGroup("camera", periods.camera_ns, tasks.camera))
    if tasks.commands is not None:
        groups.append(RateGroup("commands", COMMAND_PERIOD_NS, tasks.commands))
    groups.append(RateGroup("health", HEALTH_PERIOD_NS, tasks.health))
    groups.append(RateGroup("housekeeping", SECOND_NS, tasks.housekeeping))
    return groups
