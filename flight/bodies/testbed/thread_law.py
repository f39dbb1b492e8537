"""The attitude law of the testbed: an angle about the thread, at rest or turning on."""

from __future__ import annotations

from dataclasses import dataclass

from flight.loop.control_output import Target
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import about_axis_y
from knightcube.gnc.guidance.one_axis.plant import angle_of


@dataclass(frozen=True, slots=True)
class ThreadLaw:
    """Reach `q2` at `rate` rad/s and keep that rate; zero holds the attitude."""

    q2: float
    rate: float = 0.0

    @property
    def text(self) -> str:
        """The law in words, for events."""
        return f"q2 {self.q2:+.3f}"

    def quaternion(self, now_ns: int) -> FloatArray:
        """Return the attitude (4,) to be reached, reference into body."""
        return about_axis_y(angle_of(self.q2))


def law_of(target: Target) -> ThreadLaw:
    """Return the law of a target of the testbed."""
    law = target.law
    assert isinstance(law, ThreadLaw), "only the testbed's own targets reach its planner"
    return law
