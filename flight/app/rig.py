"""The hardware that is flown, whichever kind it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hal.guardian.client import CoilReach
from hal.interfaces.wires import Clock, Wires


@dataclass(frozen=True, slots=True)
class Rig:
    """A clock, the wires, and what else depends on the kind of hardware.

    `release` is told mission time zero; `latency` of planner and vision in ns holds in lock-step only, and
    `reach`, by which a guardian zeroes the coils, in real time only. `host` breaks what is in this process,
    where a simulation asks for that.
    """

    clock: Clock
    wires: Wires
    release: Callable[[int], None]
    realtime: bool
    seed: int
    latency: tuple[int, int] = (0, 0)
    reach: CoilReach | None = None
    host: Any = None
