"""Interface between simulated worlds and emulated devices, and recorder of the true state.

A configuration names its world in `simulation.world`. The name of a world is a key of `WORLDS`, or
`module:factory` for a factory of another package. A factory takes `WorldInputs` and returns a `World`. A
world in orbit implements `OrbitingWorld`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from flight.link.telemetry.definitions import (
    ORBIT_TRUTH,
    TRUE_COIL_CURRENTS,
    TRUE_DESCRIPTION,
    TRUE_POWER,
    TRUTH,
)
from flight.link.telemetry.packets import Packer
from flight.schema.document import ConfigError, call_named, imported
from flight.schema.sections import Config
from hal.interfaces.devices import MOST_COILS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH
from knightcube.astro.quaternion import about_axis_y
from sim_hal.clock import NEVER
from sim_hal.settings import Simulation

STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True, slots=True)
class BodyMotion:
    """Measurements of an ideal inertial unit at one instant.

    Attributes:
        time_ns: simulation time.
        quaternion: attitude quaternion (4,), reference frame into body, scalar last.
        rate: rotation rate (3,), rad/s, body axes.
        field_body: magnetic field (3,), T, body axes.
        specific_force_body: specific force (3,), m/s^2, body axes; at rest it points upwards.
    """

    time_ns: int
    quaternion: FloatArray
    rate: FloatArray
    field_body: FloatArray
    specific_force_body: FloatArray


def about_thread(time_ns: int, angle: float, rate: float, field: float) -> BodyMotion:
    """Return the motion of a body on the testbed's thread at `angle` rad and `rate` rad/s.

    The magnetic field of `field` T points along -z of the testbed frame.
    """
    return BodyMotion(
        time_ns=time_ns,
        quaternion=about_axis_y(angle),
        rate=np.array([0.0, rate, 0.0]),
        # The field (0, 0, -field) and the specific force (0, -g, 0) are rotated into body axes.
        field_body=np.array([field * math.sin(angle), 0.0, -field * math.cos(angle)]),
        specific_force_body=np.array([0.0, -STANDARD_GRAVITY, 0.0]),
    )


WORLDS = {
    "testbed": "sim_hal.worlds.testbed:make",
    "cage": "sim_hal.worlds.testbed:make_caged",
    "free_body": "sim_hal.worlds.free_body:make",
    "bench": "sim_hal.worlds.testbed:make_held",
}


@dataclass(frozen=True, slots=True, eq=False)
class WorldTruth:
    """Quantities of the truth log other than the motion: coil currents and energies.

    Attributes:
        current: mean coil currents (n,) that acted on the body, A.
        energy: integral of R I^2 over time since the release, summed over the coils, J.
        supply_energy: integral of V |I| over time since the release, summed over the coils, J.
    """

    current: FloatArray
    energy: float
    supply_energy: float


@runtime_checkable
class World(Protocol):
    """Protocol of a world: a body and its environment, advanced in time under the coil currents."""

    def release_at(self, time_ns: int) -> None:
        """Release the body at the present or a later time `time_ns`, until which it is held still."""

    def advance_to(self, time_ns: int) -> None:
        """Advance the state to `time_ns` under the present coil currents."""

    def motion(self, time_ns: int) -> BodyMotion:
        """Advance to `time_ns` and return attitude, rate, field and specific force."""

    def truth(self) -> WorldTruth:
        """Return the present coil currents and the energies so far."""


@dataclass(frozen=True, slots=True)
class WorldInputs:
    """Inputs from which a factory creates a world.

    Attributes:
        config: flight configuration, used for values that the `simulation` section does not give.
        section: `simulation` section of the configuration.
        currents: function that returns the present coil currents (n,), A.
        start_ns: simulation time at the start, ns.
    """

    config: Config
    section: Simulation
    currents: Callable[[], FloatArray]
    start_ns: int


def make_world(inputs: WorldInputs) -> World:
    """Return the world that a configuration names.

    Raises ConfigError if the name is neither a key of `WORLDS` nor a factory.
    """
    named = inputs.section.world
    factory = imported("simulation.world", named, WORLDS, os.environ)
    world = call_named("simulation.world", named, factory, inputs) if callable(factory) else None
    if not isinstance(world, World):
        raise ConfigError(
            "simulation.world", f"is {named!r}: its factory returns no World (sim_hal.worlds.world)"
        )
    return world


Floats = tuple[float, float, float]

CAUSES = ("coils", "residual dipole", "gravity gradient", "drag", "sunlight")


class OrbitEnvironment(NamedTuple):
    """Position, magnetic field, sunlight and air density of the craft at one instant; vectors are in ICRS.

    Attributes:
        position: geocentric position (3,), m.
        velocity: velocity (3,), m/s.
        field: magnetic field (3,), T.
        sun: direction (3,) from the craft to the Sun.
        light: intensity of the sunlight relative to that at one astronomical unit, 0 in the umbra.
        sunlit: visible fraction of the Sun's disc.
        density: air density, kg/m^3.
        walk: random walk (3,) of the residual dipole, scaled to unit standard deviation, body axes.
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
    """The true state of a world in orbit, with vectors in ICRS unless stated otherwise.

    Attributes:
        utc: Julian date (UTC).
        quaternion: attitude quaternion (4,), ICRS into body.
        rate: rotation rate (3,), rad/s, body axes.
        position, velocity, field, sun, sunlit: as in `OrbitEnvironment`.
        residual_dipole: residual dipole (3,), A m^2, body axes.
        torques: function that returns a dict from each cause in `CAUSES` to its torque (3,), N m, body axes.
            The dict is empty if the world does not provide separate torques.
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
    """Protocol of a world with an orbit, which GPS receiver, solar cells and horizon cameras need."""

    def surroundings(self) -> OrbitEnvironment:
        """Return the environment of the craft at the present time."""

    def utc_ns(self) -> int:
        """Return the present UTC, ns since 1970."""

    def orbit_truth(self) -> OrbitTruth:
        """Return the present state of body, orbit and environment."""


def orbiting(world: World, section: str) -> OrbitingWorld:
    """Return `world`. Raises ConfigError, with the name `section`, if the world has no orbit."""
    if not isinstance(world, OrbitingWorld):
        raise ConfigError(section, "needs a world with an orbit, such as `simulation.world: free_body`")
    return world


def utc_date(world: OrbitingWorld) -> float:
    """Return the present Julian date (UTC) of a world."""
    return UNIX_EPOCH + world.utc_ns() * 1e-9 / DAY


PERIOD_NS = 25_000_000
ORBIT_PERIOD_NS = 1_000_000_000
_UNKNOWN = np.full(3, np.nan)


class PacketLog(Protocol):
    """A log of packets."""

    def write(self, packet: bytes) -> None:
        """Append a packet."""


class RecordedPower(Protocol):
    """Protocol of a simulated power system whose state is recorded."""

    def truth(self) -> Mapping[str, float]:
        """Return the fields of the packet `true_power`."""


class TruthRecorder:
    """Recorder of the true state in a packet log: body at 40 Hz, orbit and power system at 1 Hz."""

    def __init__(self, log: PacketLog) -> None:
        self._log = log
        self._packer = Packer()
        self._world: World | None = None
        self.power: RecordedPower | None = None
        self._description: Mapping[str, FloatArray] | None = None
        self._epoch_ns = 0
        self._due_ns = NEVER

    def watch(self, world: World, description: Mapping[str, FloatArray] | None = None) -> None:
        """Set the world whose state is recorded, and the true description of its satellite, if known."""
        self._world, self._description = world, description

    def begin(self, epoch_ns: int) -> None:
        """Begin recording at mission time zero, which is `epoch_ns`."""
        self._epoch_ns = self._due_ns = epoch_ns
        if self._description is not None:
            fields = {name: value.ravel().tolist() for name, value in self._description.items()}
            self._log.write(self._packer.pack(TRUE_DESCRIPTION, 0, **fields))

    def next_event_ns(self) -> int:
        """Return the time (ns) at which the next record is due."""
        return self._due_ns

    def advance(self, now_ns: int) -> None:
        """Write all records that are due by `now_ns`."""
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
            current=truth.current[:3].tolist(),
            energy=truth.energy,
            supply_energy=truth.supply_energy,
        )
        self._log.write(packet)
        if len(truth.current) > 3:
            padded = [*truth.current.tolist(), *[math.nan] * (MOST_COILS - len(truth.current))]
            self._log.write(self._packer.pack(TRUE_COIL_CURRENTS, since_ns, current=padded))
        if since_ns % ORBIT_PERIOD_NS == 0 and self.power is not None:
            self._log.write(self._packer.pack(TRUE_POWER, since_ns, **self.power.truth()))
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
