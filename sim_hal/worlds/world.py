"""The world seam: what the emulated devices need of any simulated world.

A configuration names its world in `simulation.world`: one of `WORLDS`, or a third party's factory as
`module:factory`, which takes `WorldInputs` and returns a `World`. A world in orbit is an `OrbitingWorld`.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from flight.schema.errors import ConfigError
from flight.schema.sections import Config
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import about_axis_y
from sim_hal.settings import Simulation

STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True, slots=True)
class BodyMotion:
    """The measurements of an ideal inertial unit at one time.

    Attributes:
        time_ns: simulation time.
        quaternion: (4,) reference frame (the testbed's T) into body, scalar last.
        rate: (3,) rad/s, body axes.
        field_body: (3,) T, body axes.
        specific_force_body: (3,) m/s^2, body axes; at rest it points up.
    """

    time_ns: int
    quaternion: FloatArray
    rate: FloatArray
    field_body: FloatArray
    specific_force_body: FloatArray


def about_thread(time_ns: int, angle: float, rate: float, field: float) -> BodyMotion:
    """Return the motion of a body turned on the thread by `angle` rad, at `rate` rad/s, `field` T on -z_T."""
    return BodyMotion(
        time_ns=time_ns,
        quaternion=about_axis_y(angle),
        rate=np.array([0.0, rate, 0.0]),
        # (0, 0, -field) and the specific force of the thread (0, -g, 0), turned into body axes.
        field_body=np.array([field * math.sin(angle), 0.0, -field * math.cos(angle)]),
        specific_force_body=np.array([0.0, -STANDARD_GRAVITY, 0.0]),
    )


WORLDS = {
    "testbed": "sim_hal.worlds.testbed:make",
    "cage": "sim_hal.worlds.cage:make",
    "free_body": "sim_hal.worlds.free_body.body:make",
}


@dataclass(frozen=True, slots=True, eq=False)
class WorldTruth:
    """The quantities in the truth log besides the motion.

    Attributes:
        current: (3,) A, mean currents that acted on the body.
        energy: J, integral of R I^2 over all coils since the release.
        supply_energy: J, integral of V |I| over all coils since the release.
    """

    current: FloatArray
    energy: float
    supply_energy: float


@runtime_checkable
class World(Protocol):
    """The body and its surroundings, advanced in time under the currents that the coils carry."""

    def release_at(self, time_ns: int) -> None:
        """Release the body at `time_ns`, now or later; until then it is held still."""

    def advance_to(self, time_ns: int) -> None:
        """Advance the state to `time_ns` under the present currents."""

    def motion(self, time_ns: int) -> BodyMotion:
        """Return attitude, rate, field and specific force at `time_ns`, which is never before the state."""

    def truth(self) -> WorldTruth:
        """Return currents and energies of the present state."""


@dataclass(frozen=True, slots=True)
class WorldInputs:
    """The inputs of a world.

    Attributes:
        config: the flight configuration, for values that `section` leaves out.
        section: the `simulation` section.
        currents: returns (3,) A that the coils carry now.
        start_ns: the simulation's time at the start.
    """

    config: Config
    section: Simulation
    currents: Callable[[], FloatArray]
    start_ns: int


def make_world(inputs: WorldInputs) -> World:
    """Return the world that a configuration names. Raises ConfigError."""
    named = inputs.section.world
    module, colon, name = WORLDS.get(named, named).partition(":")
    if not (module and colon and name):
        raise ConfigError(
            "simulation.world", f"is {named!r}: name one of {', '.join(WORLDS)}, or `module:factory`"
        )
    try:
        factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError("simulation.world", f"is {named!r}, which cannot be imported: {error}") from error
    world = factory(inputs) if callable(factory) else None
    if not isinstance(world, World):
        raise ConfigError(
            "simulation.world", f"is {named!r}: its factory returns no World (sim_hal.worlds.world)"
        )
    return world


Floats = tuple[float, float, float]

CAUSES = ("coils", "residual dipole", "gravity gradient", "drag", "sunlight")


class OrbitEnvironment(NamedTuple):
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

    def surroundings(self) -> OrbitEnvironment:
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
