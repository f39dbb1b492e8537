"""What surrounds a craft in orbit at an instant, and the world that has such surroundings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from flight.schema.errors import ConfigError
from knightcube.astro.arrays import FloatArray
from sim_hal.worlds.world import World, WorldTruth

Floats = tuple[float, float, float]

CAUSES = ("coils", "residual dipole", "gravity gradient", "drag", "sunlight")


class Surroundings(NamedTuple):
    """What surrounds the craft at an instant, ICRS.

    Attributes:
        position: (3,) m. velocity: (3,) m/s. field: (3,) T.
        sun: (3,) its direction from the craft.
        light: sunlight over that at one astronomical unit; 0 in the umbra.
        sunlit: the share of the Sun's disc that is seen.
        density: of the air, kg/m^3.
        walk: (3,) of the walking dipole, of unit standard deviation, body axes.
    """

    position: Floats
    velocity: Floats
    field: Floats
    sun: Floats
    light: float
    sunlit: float
    density: float
    walk: Floats


@dataclass(frozen=True, slots=True, eq=False)
class OrbitTruth(WorldTruth):
    """The state of a world in orbit; vectors in ICRS where nothing else is said.

    Attributes:
        utc: Julian date. quaternion: (4,) ICRS into body. rate: (3,) rad/s, body axes.
        position: (3,) m. velocity: (3,) m/s. field: (3,) T.
        sun: (3,) its direction. sunlit: share of its disc that is seen.
        residual_dipole: (3,) A m^2, body axes.
        causes: evaluates `torques`, which few readers want.
    """

    utc: float
    quaternion: FloatArray
    rate: FloatArray
    position: FloatArray
    velocity: FloatArray
    field: FloatArray
    sun: FloatArray
    sunlit: float
    residual_dipole: FloatArray
    causes: Callable[[], dict[str, FloatArray]]

    @property
    def torques(self) -> dict[str, FloatArray]:
        """Torques (3,) N m, body axes, by `CAUSES`; empty where the world does not know them apart."""
        return self.causes()


@runtime_checkable
class OrbitingWorld(World, Protocol):
    """A world with an orbit: what GPS receiver, solar strings and wide cameras measure."""

    def surroundings(self) -> Surroundings:
        """Return what surrounds the craft at the present state."""

    def utc_ns(self) -> int:
        """Return UTC of the present state, ns since 1970."""

    def orbit_truth(self) -> OrbitTruth:
        """Return all of the present state, with the torques by their causes."""


def orbiting(world: World, section: str) -> OrbitingWorld:
    """Return the world as one with an orbit, for a device of `section`. Raises ConfigError without orbit."""
    if not isinstance(world, OrbitingWorld):
        raise ConfigError(section, "needs a world with an orbit, such as `simulation.world: free_body`")
    return world
