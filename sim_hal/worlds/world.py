"""The world seam: what the emulated devices need of any simulated world.

A configuration names its world in `simulation.world`: one of `WORLDS`, or a third party's factory as
`module:factory`, which takes `WorldInputs` and returns a `World`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from flight.schema.errors import ConfigError
from flight.schema.sections import Config
from knightcube.astro.arrays import FloatArray
from sim_hal.settings import Simulation
from sim_hal.worlds.motion import Motion

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

    def motion(self, time_ns: int) -> Motion:
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
