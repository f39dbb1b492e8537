"""The interface between simulated worlds and emulated devices, and the recorder of the true state.

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

from flight.link.telemetry.definitions import ORBIT_TRUTH, TRUTH
from flight.link.telemetry.packets import Packer
from flight.schema.document import ConfigError
from flight.schema.sections import Config
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH
from knightcube.astro.quaternion import about_axis_y
from sim_hal.clock import NEVER
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
    """Return the motion of a body on the thread at `angle` rad and `rate` rad/s, with `field` T on -z_T."""
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
    "cage": "sim_hal.worlds.testbed:make_caged",
    "free_body": "sim_hal.worlds.free_body:make",
}


@dataclass(frozen=True, slots=True, eq=False)
class WorldTruth:
    """The quantities of the truth log other than the motion.

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
    """The body and its environment, advanced in time under the currents that the coils carry."""

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
    """Position, field, light and air of the craft at one time; vectors in ICRS.

    Attributes:
        position: (3,) m.
        velocity: (3,) m/s.
        field: (3,) T.
        sun: (3,) direction from the craft to the Sun.
        light: sunlight relative to its intensity at one astronomical unit; 0 in the umbra.
        sunlit: visible fraction of the Sun's disc.
        density: kg/m^3, of the air.
        walk: (3,) random walk of the residual dipole, of unit standard deviation, body axes.
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
    """The state of a world in orbit; vectors in ICRS unless stated otherwise.

    Attributes:
        utc: Julian date.
        quaternion: (4,) ICRS into body.
        rate: (3,) rad/s, body axes.
        position: (3,) m.
        velocity: (3,) m/s.
        field: (3,) T.
        sun: (3,) direction from the craft to the Sun.
        sunlit: visible fraction of the Sun's disc.
        residual_dipole: (3,) A m^2, body axes.
        torques: evaluates the torques (3,) N m, body axes, by `CAUSES`; empty if the world does not know
            them separately.
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
    torques: Callable[[], dict[str, FloatArray]]


@runtime_checkable
class OrbitingWorld(World, Protocol):
    """A world with an orbit, as GPS receiver, solar cells and horizon cameras need it."""

    def surroundings(self) -> OrbitEnvironment:
        """Return the environment of the craft at the present state."""

    def utc_ns(self) -> int:
        """Return UTC of the present state, ns since 1970."""

    def orbit_truth(self) -> OrbitTruth:
        """Return the whole present state."""


def orbiting(world: World, section: str) -> OrbitingWorld:
    """Return the world if it has an orbit. Raises ConfigError, naming `section`, if it has none."""
    if not isinstance(world, OrbitingWorld):
        raise ConfigError(section, "needs a world with an orbit, such as `simulation.world: free_body`")
    return world


def utc_date(world: OrbitingWorld) -> float:
    """Return the Julian date, UTC, of the present state of a world."""
    return UNIX_EPOCH + world.utc_ns() * 1e-9 / DAY


PERIOD_NS = 25_000_000
ORBIT_PERIOD_NS = 1_000_000_000
_UNKNOWN = np.full(3, np.nan)


class PacketLog(Protocol):
    """A log of packets."""

    def write(self, packet: bytes) -> None:
        """Append a packet."""


class TruthRecorder:
    """Writes the true state at 40 Hz, and that of an orbit at 1 Hz, to a log; an emulated device."""

    def __init__(self, log: PacketLog) -> None:
        self._log = log
        self._packer = Packer()
        self._world: World | None = None
        self._epoch_ns = 0
        self._due_ns = NEVER

    def watch(self, world: World) -> None:
        """Record this world."""
        self._world = world

    def begin(self, epoch_ns: int) -> None:
        """Record from mission time zero, `epoch_ns`, on."""
        self._epoch_ns = self._due_ns = epoch_ns

    def next_event_ns(self) -> int:
        """Return when the next record is due."""
        return self._due_ns

    def advance(self, now_ns: int) -> None:
        """Write the records that are due."""
        while self._due_ns <= now_ns:
            if self._world is not None:
                self._write(self._world, self._due_ns)
            self._due_ns += PERIOD_NS

    def _write(self, world: World, time_ns: int) -> None:
        since_ns = time_ns - self._epoch_ns
        motion, truth = world.motion(time_ns), world.truth()
        packet = self._packer.pack(
            TRUTH,
            since_ns,
            quaternion=motion.quaternion.tolist(),
            rate=motion.rate.tolist(),
            current=truth.current.tolist(),
            energy=truth.energy,
            supply_energy=truth.supply_energy,
        )
        self._log.write(packet)
        if since_ns % ORBIT_PERIOD_NS != 0 or not isinstance(world, OrbitingWorld):
            return
        orbit = world.orbit_truth()
        torques = orbit.torques()
        coils, dipole, gravity, drag, sunlight = (torques.get(cause, _UNKNOWN).tolist() for cause in CAUSES)
        packet = self._packer.pack(
            ORBIT_TRUTH,
            since_ns,
            utc=orbit.utc,
            position=orbit.position.tolist(),
            velocity=orbit.velocity.tolist(),
            field=orbit.field.tolist(),
            sun=orbit.sun.tolist(),
            sunlit=orbit.sunlit,
            residual_dipole=orbit.residual_dipole.tolist(),
            coil_torque=coils,
            dipole_torque=dipole,
            gravity_torque=gravity,
            drag_torque=drag,
            sunlight_torque=sunlight,
        )
        self._log.write(packet)
