"""The worlds of a laboratory: the testbed on its thread, the testbed in a cage, and a body held by hand.

The testbed is a rigid body on a thread in the field of a Helmholtz coil, controlled by torque coils. The
model is that of Sease 2013, chapter 5. The testbed has one degree of freedom, the angle theta about the
thread, with J theta'' = M - k theta - c theta', where M is the component of m x B along the thread. The
testbed frame T has y down along the thread and the magnetic field along -z. The body axes coincide with the
axes of T at theta = 0. The coil on body x gives the torque n A B I cos(theta) (Sease, eq. 5.4), the coil on
body z gives n A B I sin(theta), and the coil on body y has no effect because its axis lies along the thread.

The body held by hand on a bench is the world of `knightcube bringup` with emulated devices. The body stands
with its z axis up until it is rotated by hand. The receiver and other devices that need an orbit are on the
configured orbit, as if a signal simulator were connected to the GPS receiver.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from flight.schema.bodies import OrbitConfig, TestbedConfig, as_testbed
from flight.schema.document import ConfigError
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_matrix, from_rotation_vector, multiply
from sim_hal.settings import CageTruth, Disturbances, Simulation
from sim_hal.worlds.world import (
    STANDARD_GRAVITY,
    BodyMotion,
    OrbitEnvironment,
    OrbitingWorld,
    OrbitTruth,
    WorldInputs,
    WorldTruth,
    about_thread,
)

VACUUM_PERMEABILITY = 4e-7 * math.pi
"""Vacuum permeability (T m/A), with the value of Sease 2013."""


def helmholtz_field(turns: float, current: float, radius: float) -> float:
    """Return the field (T) at the centre of a Helmholtz pair.

    Each coil has `turns` turns of `radius` m and carries `current` A.
    """
    return math.pow(0.8, 1.5) * VACUUM_PERMEABILITY * turns * current / radius


_LONGEST_STEP = 0.025
"""Longest step (s) of the integration."""


@dataclass(frozen=True, slots=True)
class TestbedModel:
    """The true constants of the testbed in SI units.

    Attributes:
        inertia: moment of inertia about the thread, kg m^2.
        dipole_per_ampere: number of turns times area of each coil, m^2.
        field: horizontal magnetic field, T.
        stiffness: torsional stiffness of the thread, N m/rad.
        damping: damping by thread and air, N m s/rad.
        resistance: resistance of each of the three coils, ohm.
        supply_voltage: voltage across a coil that is fully on, V.
    """

    __test__ = False  # prevents pytest from collecting the class as a test

    inertia: float
    dipole_per_ampere: float
    field: float
    stiffness: float
    damping: float
    resistance: tuple[float, ...]
    supply_voltage: float


class Testbed:
    """World with the testbed, whose state is advanced in time under the coil currents."""

    __test__ = False

    def __init__(
        self,
        model: TestbedModel,
        angle: float,
        release_rate: float,
        currents: Callable[[], FloatArray],
        start_ns: int = 0,
    ) -> None:
        """Create the testbed with a body held at `angle` rad until its release with `release_rate` rad/s."""
        self._model, self._currents, self._release_rate = model, currents, release_rate
        self._release_ns: int | None = None
        self._held = True
        self.time_ns = start_ns
        self.angle = angle
        self.rate = 0.0
        self.energy = 0.0
        self.supply_energy = 0.0
        self.mean_current: FloatArray = np.zeros(3)

    def release_at(self, time_ns: int) -> None:
        """Release the body at `time_ns`, which is not before the present time."""
        self._release_ns = time_ns

    def advance_to(self, time_ns: int) -> None:
        """Advance the state to `time_ns` under the present coil currents (classical Runge-Kutta)."""
        if self._held:
            if self._release_ns is None or time_ns < self._release_ns:
                self.time_ns = max(self.time_ns, time_ns)
                return
            self._held = False
            self.time_ns = max(self.time_ns, self._release_ns)
            self.rate = self._release_rate
        span = (time_ns - self.time_ns) * 1e-9
        if span <= 0.0:
            return
        self.mean_current = self._currents()
        ix, iy, iz = self.mean_current.tolist()
        steps = max(1, math.ceil(span / _LONGEST_STEP))
        for _ in range(steps):
            self._step(span / steps, ix, iz)
        rx, ry, rz = self._model.resistance
        self.energy += span * (rx * ix * ix + ry * iy * iy + rz * iz * iz)
        self.supply_energy += span * self._model.supply_voltage * (abs(ix) + abs(iy) + abs(iz))
        self.time_ns = time_ns

    def motion(self, time_ns: int) -> BodyMotion:
        """Advance to `time_ns` and return the motion. The time must not be before the present state."""
        self.advance_to(time_ns)
        return about_thread(self.time_ns, self.angle, self.rate, self._model.field)

    def truth(self) -> WorldTruth:
        """Return the present coil currents and the energies so far."""
        return WorldTruth(self.mean_current, self.energy, self.supply_energy)

    def _acceleration(self, angle: float, rate: float, ix: float, iz: float) -> float:
        m = self._model
        dipole = m.dipole_per_ampere * (ix * math.cos(angle) + iz * math.sin(angle))
        return (dipole * m.field - m.stiffness * angle - m.damping * rate) / m.inertia

    def _step(self, dt: float, ix: float, iz: float) -> None:
        angle, rate, half = self.angle, self.rate, 0.5 * dt
        a1 = self._acceleration(angle, rate, ix, iz)
        v2 = rate + half * a1
        a2 = self._acceleration(angle + half * rate, v2, ix, iz)
        v3 = rate + half * a2
        a3 = self._acceleration(angle + half * v2, v3, ix, iz)
        v4 = rate + dt * a3
        a4 = self._acceleration(angle + dt * v3, v4, ix, iz)
        self.angle = angle + dt / 6.0 * (rate + 2.0 * v2 + 2.0 * v3 + v4)
        self.rate = rate + dt / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)


def make(inputs: WorldInputs) -> Testbed:
    """Return the testbed that a configuration describes.

    Raises ConfigError if `simulation.release` is missing.
    """
    model, angle, rate = model_of(as_testbed(inputs.config), inputs.section)
    return Testbed(model, angle, rate, inputs.currents, inputs.start_ns)


def model_of(config: TestbedConfig, section: Simulation) -> tuple[TestbedModel, float, float]:
    """Return the true constants of the testbed, and the angle (rad) and rate (rad/s) at release.

    Values of the simulation section `section` override the values of `config`. Raises ConfigError if
    `simulation.release` is missing.
    """
    release = section.release
    if release is None:
        raise ConfigError("simulation.release", "is missing: the world testbed needs it")
    plant, truth = config.plant, section.truth
    model = TestbedModel(
        inertia=truth.inertia or plant.inertia,
        dipole_per_ampere=plant.coil_turns * plant.coil_area,
        field=truth.field or plant.field,
        stiffness=section.thread.stiffness,
        damping=section.thread.damping,
        resistance=truth.resistance or config.coils.resistance,
        supply_voltage=truth.supply_voltage or config.coils.supply_voltage,
    )
    return model, 2.0 * float(np.arcsin(release.q2)), release.rate


_CAGE_STREAM = 0xCA6E


class OrbitField:
    """Magnetic field of a Helmholtz cage that reproduces the field along an orbit.

    The reproduced field is IGRF-14 with a ring current along an orbit under J2, in the local frame whose y
    axis is the axis of the thread. The cage produces the components perpendicular to the thread, multiplied
    by the cage's scale and the gain of its coils. The flight software uses a different model
    (`flight.bodies.testbed.control`).
    """

    def __init__(self, section: CageTruth, scale: float, utc: str, seed: int) -> None:
        # The module `orbit` is imported only here, because a testbed without a cage does not need it.
        from sim_hal.worlds.orbit import Environment, elements, julian_date  # noqa: PLC0415

        date = julian_date(utc)
        generator = np.random.default_rng([seed, _CAGE_STREAM])
        multiples = Disturbances(ring_current=section.ring_current)
        start = elements(section.orbit, date, "simulation.cage.orbit")
        self._environment = Environment(start, date, generator, multiples)
        self._scale = scale * section.gain

    def at(self, seconds: float) -> tuple[float, float]:
        """Return the field's components along x and z (T) at `seconds` after the start."""
        position, velocity, field = (np.array(vector) for vector in self._environment.at(seconds)[:3])
        down = -position / np.linalg.norm(position)
        across = np.cross(velocity, position)
        ahead = np.cross(across / np.linalg.norm(across), down)
        return self._scale * float(field @ ahead), self._scale * float(field @ down)


class CagedTestbed(Testbed):
    """World with the testbed in the variable field of the cage instead of a constant field."""

    def __init__(
        self,
        model: TestbedModel,
        angle: float,
        release_rate: float,
        currents: Callable[[], FloatArray],
        field: OrbitField,
        start_ns: int = 0,
    ) -> None:
        """Create the testbed with a body held at `angle` rad until its release with `release_rate` rad/s."""
        super().__init__(model, angle, release_rate, currents, start_ns)
        self._orbit, self._start_ns = field, start_ns
        self._bx, self._bz = field.at(0.0)

    def advance_to(self, time_ns: int) -> None:
        """Advance the state to `time_ns`; the field is kept constant during the few ms of this call."""
        if time_ns > self.time_ns:
            self._bx, self._bz = self._orbit.at((time_ns - self._start_ns) * 1e-9)
        super().advance_to(time_ns)

    def motion(self, time_ns: int) -> BodyMotion:
        """Advance to `time_ns` and return the motion."""
        motion = super().motion(time_ns)
        bx, bz = self._in_body(self.angle)
        return replace(motion, field_body=np.array([bx, 0.0, bz]))

    def _in_body(self, angle: float) -> tuple[float, float]:
        sine, cosine = math.sin(angle), math.cos(angle)
        return self._bx * cosine - self._bz * sine, self._bx * sine + self._bz * cosine

    def _acceleration(self, angle: float, rate: float, ix: float, iz: float) -> float:
        m = self._model
        bx, bz = self._in_body(angle)
        torque = m.dipole_per_ampere * (iz * bx - ix * bz)
        return (torque - m.stiffness * angle - m.damping * rate) / m.inertia


def make_caged(inputs: WorldInputs) -> CagedTestbed:
    """Return the caged testbed that a configuration describes.

    Raises ConfigError if the section `cage` or `simulation.cage` is missing.
    """
    config, section = as_testbed(inputs.config), inputs.section
    if config.cage is None or section.cage is None:
        missing = "cage" if config.cage is None else "simulation.cage"
        raise ConfigError(missing, "is missing: the simulated Helmholtz coil needs it")
    model, angle, rate = model_of(config, section)
    field = OrbitField(section.cage, config.cage.scale, section.utc, section.seed)
    return CagedTestbed(model, angle, rate, inputs.currents, field, inputs.start_ns)


LABORATORY_FIELD = np.array([3.0e-6, 4.2e-5, -2.1e-5])
"""Magnetic field (T) in the testbed frame: 47 uT with a dip of 63 deg, as in central Europe."""
_UPRIGHT = from_matrix(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]))


class HeldBody:
    """A body that rests with its z axis up, or is rotated about one of its axes.

    Attributes:
        held: true for a body on a bench; Earth and Sun are not in view of its star camera.
    """

    held = True

    def __init__(self) -> None:
        self._start = _UPRIGHT
        self._axis: FloatArray = np.zeros(3)
        self._angle, self._begin_ns, self._span = 0.0, 0, 1.0

    def turn(self, axis: FloatArray, angle: float, begin_ns: int, seconds: float) -> None:
        """Rotate the upright body about `axis` (3,), body axes, by `angle` rad, from `begin_ns` on."""
        self._axis, self._angle, self._begin_ns, self._span = axis, angle, begin_ns, seconds

    def release_at(self, time_ns: int) -> None:
        """Do nothing, because the body is held by hand and is never released."""

    def advance_to(self, time_ns: int) -> None:
        """Do nothing, because the motion is a function of time."""

    def motion(self, time_ns: int) -> BodyMotion:
        """Return attitude, rate, field and specific force at `time_ns`."""
        share = min(max((time_ns - self._begin_ns) * 1e-9 / self._span, 0.0), 1.0)
        angle = 0.5 * self._angle * (1.0 - math.cos(math.pi * share))
        speed = 0.5 * self._angle * math.pi / self._span * math.sin(math.pi * share)
        attitude = multiply(from_rotation_vector(self._axis * angle), self._start)
        to_body = attitude_matrix(attitude)
        up = to_body @ np.array([0.0, -STANDARD_GRAVITY, 0.0])
        return BodyMotion(time_ns, attitude, self._axis * speed, to_body @ LABORATORY_FIELD, up)

    def truth(self) -> WorldTruth:
        """Return zero currents and energies, which are not recorded on a bench."""
        return WorldTruth(np.zeros(3), 0.0, 0.0)


class HeldSatellite(HeldBody):
    """A held body whose GPS receiver, solar cells and horizon cameras behave as in the given orbit."""

    def __init__(self, orbit: OrbitingWorld) -> None:
        super().__init__()
        self._orbit = orbit

    def advance_to(self, time_ns: int) -> None:
        """Advance the orbit."""
        self._orbit.advance_to(time_ns)

    def surroundings(self) -> OrbitEnvironment:
        """Return the environment in the orbit at the present time."""
        return self._orbit.surroundings()

    def utc_ns(self) -> int:
        """Return the UTC of the orbit, ns since 1970."""
        return self._orbit.utc_ns()

    def orbit_truth(self) -> OrbitTruth:
        """Return the present state in the orbit."""
        return self._orbit.orbit_truth()


def make_held(inputs: WorldInputs) -> HeldBody:
    """Return a body on a bench, with the orbit of the configuration if it has one."""
    if isinstance(inputs.config, OrbitConfig) and inputs.section.free_body is not None:
        from sim_hal.worlds import free_body  # noqa: PLC0415 - loads the models of the orbit

        return HeldSatellite(free_body.make(inputs))
    return HeldBody()
