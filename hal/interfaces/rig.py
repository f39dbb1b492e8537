"""The hardware that a flight flies, whichever kind it is: a clock and wires."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from hal.guardian.client import CoilReach
from hal.interfaces.wires import Clock, Wires


class HostFaults(Protocol):
    """Simulated faults inside the flight process itself: its workers and its disk."""

    def workers(self, specs: Sequence[Any]) -> list[Any]:
        """Return the worker specifications with functions that may fail."""

    def jobs(self, runner: Any, specs: Sequence[Any], result: Callable[..., Any]) -> Any:
        """Return a job runner before `runner` that may fail; `result` makes a job's result."""

    def opener(self, opener: Callable[[Path], Any]) -> Callable[[Path], Any]:
        """Return an opener of files on a disk that may fail."""


@dataclass(frozen=True, slots=True)
class Rig:
    """A clock, the wires, and what else depends on the kind of hardware.

    Attributes:
        release: is called with mission time zero.
        latency: of planner and vision in ns, in lock-step only.
        reach: how a guardian zeroes the coils, in real time only.
        host: faults inside this process, where a simulation asks for them.
    """

    clock: Clock
    wires: Wires
    release: Callable[[int], None]
    realtime: bool
    seed: int
    latency: tuple[int, int] = (0, 0)
    reach: CoilReach | None = None
    host: HostFaults | None = None
