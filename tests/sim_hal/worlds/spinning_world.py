"""A third-party world in which a body rotates at a constant rate about the suspension thread."""

from __future__ import annotations

import numpy as np

from flight.schema.bodies import as_testbed
from sim_hal.worlds.world import BodyMotion, WorldInputs, WorldTruth, about_thread

RATE = 0.05
NO_FACTORY = "three"


class SpinningWorld:
    def __init__(self, field: float) -> None:
        self._field = field
        self._release_ns: int | None = None
        self.time_ns = 0

    def release_at(self, time_ns: int) -> None:
        self._release_ns = time_ns

    def advance_to(self, time_ns: int) -> None:
        self.time_ns = max(self.time_ns, time_ns)

    def motion(self, time_ns: int) -> BodyMotion:
        self.advance_to(time_ns)
        turning = self._release_ns is not None and time_ns >= self._release_ns
        angle = (
            RATE * (time_ns - self._release_ns) * 1e-9 if turning and self._release_ns is not None else 0.0
        )
        return about_thread(time_ns, angle, RATE if turning else 0.0, self._field)

    def truth(self) -> WorldTruth:
        return WorldTruth(np.zeros(3), 0.0, 0.0)


def make(inputs: WorldInputs) -> SpinningWorld:
    return SpinningWorld(as_testbed(inputs.config).plant.field)


def make_nothing(inputs: WorldInputs) -> None:
    return None
