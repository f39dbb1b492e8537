"""A free body in orbit as a world: the craft of one seed, moved by its coils and by all disturbances.

The rotation is integrated when the state is read or when the currents change, not at every event between;
the result depends on the times of reading by less than a microradian. Torques of air and sunlight and the
residual dipole are held in body axes for 0.1 s.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from flight.schema.errors import ConfigError
from hal.interfaces.wires import SECOND_NS
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import DAY
from sim_hal.device import NEVER
from sim_hal.settings import FreeBodySection, OrbitSection, TipOff
from sim_hal.worlds import sun
from sim_hal.worlds.free_body.craft import CRAFTS, build
from sim_hal.worlds.free_body.environment import Environment
from sim_hal.worlds.free_body.loads import LoadModel
from sim_hal.worlds.free_body.rotation import Floats, Loads, Rotation, State, matrix, steps_within, turned
from sim_hal.worlds.orbit import KeplerianElements
from sim_hal.worlds.world import BodyMotion, OrbitEnvironment, OrbitTruth, WorldInputs, WorldTruth

_STREAM = 0xF4EE


def generators(seed: int) -> tuple[np.random.Generator, np.random.Generator, np.random.Generator]:
    """Return the generators of the craft's errors, of the release, and of air, storms and walks."""
    errors, tip_off, weather = (np.random.default_rng([seed, _STREAM, stream]) for stream in range(3))
    return errors, tip_off, weather


UNIX_EPOCH = 2_440_587.5
"""The Julian date of 1970."""
LONGEST_STEP = 0.1
"""s; air, sunlight and residual dipole are held as long, as they are in the middle of that time."""
ZERO: Floats = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class CoilSupply:
    """What the coils take: resistance (3,) ohm, and the supply's voltage."""

    resistance: tuple[float, float, float]
    supply_voltage: float


KNIGHTCUBE_SUPPLY = CoilSupply((23.0, 23.0, 23.0), 3.4)


class FreeBody:
    """The state of a free body, advanced in time under the coil currents."""

    def __init__(
        self,
        section: FreeBodySection,
        currents: Callable[[], FloatArray],
        power: CoilSupply = KNIGHTCUBE_SUPPLY,
        seed: int = 1,
        utc: str = "2026-01-01T00:00:00Z",
        start_ns: int = 0,
    ) -> None:
        """Hold the body still until it is released; `utc` labels `start_ns`."""
        errors, tip_off, weather = generators(seed)
        multiples = section.disturbances
        craft = CRAFTS[section.craft] if isinstance(section.craft, str) else section.craft
        self.craft = build(craft, multiples, errors)
        self.utc_start = julian_date(utc)
        self._utc_start_ns = round(datetime.fromisoformat(utc).timestamp()) * SECOND_NS - start_ns
        orbit = elements(section.orbit, self.utc_start)
        self.environment = Environment(orbit, self.utc_start, weather, multiples)
        self._loads = LoadModel(self.craft, multiples)
        self._rotation = Rotation(self.craft.inertia)
        self._currents, self._power = currents, power
        self._from_principal = quaternion.conjugate(self.craft.to_principal)
        x, y, z, w = self.craft.to_principal.tolist()
        self._to_principal, self._to_body = matrix(x, y, z, w), matrix(-x, -y, -z, w)
        attitude, self._tip_off = released(section.release, tip_off)
        a, b, c, d = quaternion.multiply(self.craft.to_principal, attitude).tolist()
        self._state: State = (a, b, c, d, 0.0, 0.0, 0.0)
        self._start_ns, self._release_ns = start_ns, NEVER
        self._held = True
        self._acting: Floats = ZERO
        self._seen: tuple[State, BodyMotion | None] = self._state, None
        self._slot = -1
        self._torque, self._residual = ZERO, ZERO
        # The state is of `_done_ns`; from there to `time_ns` the currents `_acting` act.
        self._done_ns = self.time_ns = start_ns
        self._pull, self._field = self._gravity_and_field(0.0)
        self.energy = 0.0
        self.supply_energy = 0.0

    def release_at(self, time_ns: int) -> None:
        """Release the body at `time_ns`, now or later."""
        self._release_ns = time_ns

    def advance_to(self, time_ns: int) -> None:
        """Advance to `time_ns` under the present currents."""
        if time_ns <= self.time_ns:
            return
        x, y, z = self._currents().tolist()
        if (x, y, z) != self._acting:
            self._integrate()
            self._acting = x, y, z
        self.time_ns = time_ns

    def motion(self, time_ns: int) -> BodyMotion:
        """Advance to `time_ns` and return the motion there; in free fall nothing presses on the body."""
        self.advance_to(time_ns)
        self._integrate()
        state, motion = self._seen
        if motion is None or motion.time_ns != self.time_ns or state is not self._state:
            motion = BodyMotion(
                time_ns=self.time_ns,
                quaternion=self._attitude(),
                rate=np.array(turned(self._to_body, self._state[4:])),
                field_body=np.array(turned(self._to_body, turned(matrix(*self._state[:4]), self._field))),
                specific_force_body=np.zeros(3),
            )
            self._seen = self._state, motion  # the truth recorder looks when the inertial unit does
        return motion

    def surroundings(self) -> OrbitEnvironment:
        """Return what surrounds the craft now, ICRS."""
        return self.environment.at(self._seconds(self.time_ns))

    def utc_ns(self) -> int:
        """Return UTC of the present state, ns since 1970."""
        return self._utc_start_ns + self.time_ns

    def truth(self) -> WorldTruth:
        """Return currents and energies of the state as it is."""
        self._integrate()
        return WorldTruth(np.array(self._acting), self.energy, self.supply_energy)

    def orbit_truth(self) -> OrbitTruth:
        """Return the state as it is; torques by their causes."""
        self._integrate()
        around, state, acting = self.surroundings(), self._state, self._acting
        return OrbitTruth(
            current=np.array(acting),
            energy=self.energy,
            supply_energy=self.supply_energy,
            utc=self.utc_start + self._seconds(self.time_ns) / DAY,
            quaternion=self._attitude(),
            rate=np.array(turned(self._to_body, state[4:])),
            position=np.array(around.position),
            velocity=np.array(around.velocity),
            field=np.array(around.field),
            sun=np.array(around.sun),
            sunlit=around.sunlit,
            residual_dipole=np.array(self._loads.residual_dipole(around)),
            causes=lambda: self._torques(around, state, acting),
        )

    def _torques(self, around: OrbitEnvironment, state: State, acting: Floats) -> dict[str, FloatArray]:
        """Return the torques (3,) N m, body axes, by their causes."""
        turn = matrix(*state[:4])
        attitude = quaternion.multiply(self._from_principal, np.array(state[:4]))
        to_body = matrix(*attitude.tolist())
        field = turned(to_body, around.field)
        drag, sunlight = self._loads.pressures(around, to_body)
        gx, gy, gz = turned(turn, self._loads.pull(around.position))
        a, b, c = self.craft.inertia
        gradient = (c - b) * gy * gz, (a - c) * gz * gx, (b - a) * gx * gy
        return {
            "coils": np.cross(self._loads.coil_dipole(acting), field),
            "residual dipole": np.cross(self._loads.residual_dipole(around), field),
            "gravity gradient": np.array(turned(self._to_body, gradient)),
            "drag": np.array(drag),
            "sunlight": np.array(sunlight),
        }

    def _integrate(self) -> None:
        """Bring the state to `time_ns`."""
        if self._held:
            if self.time_ns < self._release_ns:
                self._done_ns = self.time_ns
                self._pull, self._field = self._gravity_and_field(self._seconds(self.time_ns))
                return
            self._held = False
            self._done_ns = max(self._done_ns, self._release_ns)
            self._pull, self._field = self._gravity_and_field(self._seconds(self._done_ns))
            self._state = (*self._state[:4], *turned(self._to_principal, self._tip_off))
        start, end = self._seconds(self._done_ns), self._seconds(self.time_ns)
        if end <= start:
            return
        self._spend(end - start)
        steps = steps_within(end - start, math.hypot(*self._state[4:]), LONGEST_STEP)
        for step in range(steps):
            self._step(start + (end - start) * step / steps, start + (end - start) * (step + 1) / steps)
        self._done_ns = self.time_ns

    def _step(self, start: float, end: float) -> None:
        slot = int(0.5 * (start + end) / LONGEST_STEP)
        if slot != self._slot:
            self._slot = slot
            self._renew(start, (slot + 0.5) * LONGEST_STEP)
        pull, field = self._gravity_and_field(end)
        a, b, c = self._pull
        d, e, f = pull
        between = 0.5 * (a + d), 0.5 * (b + e), 0.5 * (c + f)
        x, y, z = self._loads.coil_dipole(self._acting)
        u, v, w = self._residual
        dipole = turned(self._to_principal, (x + u, y + v, z + w))
        loads = Loads(dipole, between, self._torque)
        self._state = self._rotation.step(self._state, end - start, self._field, field, loads)
        self._pull, self._field = pull, field

    def _renew(self, time: float, middle: float) -> None:
        """Evaluate the loads that are held in body axes, at `middle` s, with the attitude turned on to it."""
        around = self.environment.at(middle)
        ahead = (middle - time) * np.array(turned(self._to_body, self._state[4:]))
        turn = quaternion.multiply(quaternion.from_rotation_vector(ahead), self._attitude())
        (a, b, c), (d, e, f) = self._loads.pressures(around, matrix(*turn.tolist()))
        self._torque = turned(self._to_principal, (a + d, b + e, c + f))
        self._residual = self._loads.residual_dipole(around)

    def _gravity_and_field(self, time: float) -> tuple[Floats, Floats]:
        position, field = self.environment.position_and_field(time)
        return self._loads.pull(position), field

    def _attitude(self) -> FloatArray:
        return quaternion.multiply(self._from_principal, np.array(self._state[:4]))

    def _spend(self, span: float) -> None:
        x, y, z = self._acting
        a, b, c = self._power.resistance
        self.energy += span * (a * x * x + b * y * y + c * z * z)
        self.supply_energy += span * self._power.supply_voltage * (abs(x) + abs(y) + abs(z))

    def _seconds(self, time_ns: int) -> float:
        return (time_ns - self._start_ns) * 1e-9


def julian_date(utc: str) -> float:
    """Return the Julian date of an ISO 8601 time. Raises ValueError."""
    return UNIX_EPOCH + datetime.fromisoformat(utc).timestamp() / DAY


def elements(orbit: OrbitSection, date: float) -> KeplerianElements:
    """Return the elements of the orbit at a Julian date."""
    node = math.radians(orbit.ascending_node_deg)
    if orbit.local_time is not None:
        x, y, _ = sun.position(date).tolist()
        node = math.atan2(y, x) + math.radians(15.0 * (orbit.local_time - 12.0))
    return KeplerianElements(
        semi_major_axis=EARTH_RADIUS + orbit.altitude,
        eccentricity=orbit.eccentricity,
        inclination=math.radians(orbit.inclination_deg),
        ascending_node=node,
        argument_of_perigee=math.radians(orbit.argument_of_perigee_deg),
        true_anomaly=math.radians(orbit.true_anomaly_deg),
    )


def released(tip_off: TipOff, generator: np.random.Generator) -> tuple[FloatArray, Floats]:
    """Return the attitude (4,) of the release, ICRS into body, and its rate (3,) rad/s, body axes."""
    attitude = quaternion.normalise(generator.standard_normal(4))
    axis = generator.standard_normal(3)
    if tip_off.attitude is not None:
        attitude = quaternion.normalise(np.array(tip_off.attitude))
    if tip_off.rate is not None:
        return attitude, tip_off.rate
    x, y, z = (tip_off.speed * axis / np.linalg.norm(axis)).tolist()
    return attitude, (x, y, z)


def make(inputs: WorldInputs) -> FreeBody:
    """Return the free body of a configuration. Raises ConfigError without its section."""
    config, section = inputs.config, inputs.section
    if section.free_body is None:
        raise ConfigError("simulation.free_body", "is missing: the world free_body needs it")
    power = CoilSupply(
        section.truth.resistance or config.coils.resistance,
        section.truth.supply_voltage or config.coils.supply_voltage,
    )
    return FreeBody(section.free_body, inputs.currents, power, section.seed, section.utc, inputs.start_ns)
