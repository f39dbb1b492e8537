"""Basilisk as the world of a flight: `simulation.world: sim_hal.worlds.basilisk.world:make`.

This world reads the section `simulation.free_body` and builds the same craft from the same seed as the world
`free_body`, so that results can be compared. Basilisk integrates in steps of 25 ms; between two steps the
motion is extrapolated with the last rate. A change of the coil currents takes effect at the next step. The
random walks of air density and residual dipole, the ring current and the diurnal bulge of the atmosphere are
not modelled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from flight.schema.document import ConfigError
from hal.interfaces.wires import SECOND_NS
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, DAY, UNIX_EPOCH
from sim_hal.clock import NEVER
from sim_hal.description_errors import NO_ERRORS, DescriptionErrors
from sim_hal.settings import FreeBodySection, utc_seconds
from sim_hal.worlds.basilisk import STEP_NS
from sim_hal.worlds.free_body import (
    KNIGHTCUBE_SUPPLY,
    CoilSupply,
    CraftModel,
    body_inputs,
    built_craft,
    generators,
    released,
)
from sim_hal.worlds.orbit import elements, julian_date, sun_position
from sim_hal.worlds.world import (
    BodyMotion,
    Floats,
    OrbitEnvironment,
    OrbitTruth,
    WorldInputs,
    WorldTruth,
    utc_date,
)

if TYPE_CHECKING:
    from sim_hal.worlds.basilisk.scenario import BasiliskScenario


class BasiliskWorld:
    """A craft in a Basilisk simulation; an `OrbitingWorld`."""

    def __init__(
        self,
        section: FreeBodySection,
        currents: Callable[[], FloatArray],
        supply: CoilSupply = KNIGHTCUBE_SUPPLY,
        seed: int = 1,
        utc: str = "2026-01-01T00:00:00Z",
        start_ns: int = 0,
        description: DescriptionErrors = NO_ERRORS,
        craft: CraftModel | None = None,
    ) -> None:
        """Create the world with a body that is held still until its release.

        The craft is `craft` or, if that is None, the craft that `section` describes.

        Raises ConfigError if Basilisk is not installed.
        """
        if section.disturbances.gravity_gradient not in {0.0, 1.0}:
            raise ConfigError("simulation.free_body.disturbances.gravity_gradient", "is 0 or 1 in Basilisk")
        errors, tip_off, _ = generators(seed)
        self.craft = built_craft(section, errors, description, craft)
        self._attitude, rate = released(section.release, tip_off)
        self._tip_off = np.array(rate)
        self._utc_start_ns = round(utc_seconds(utc)) * SECOND_NS
        self._start_ns, self._release_ns, self._held = start_ns, NEVER, True
        orbit = elements(section.orbit, julian_date(utc))
        self._scenario = _scenario()(
            self.craft, section.disturbances, orbit, self._attitude, self._utc_start_ns
        )
        self._currents, self._supply = currents, supply
        self._acting: FloatArray = np.zeros(3)
        self._stepped_ns = 0  # Basilisk's time begins at zero
        self._placed_ns = 0
        self.time_ns = start_ns
        self.energy = self.supply_energy = 0.0

    def release_at(self, time_ns: int) -> None:
        """Release the body at the first step at or after `time_ns`."""
        self._release_ns = time_ns

    def advance_to(self, time_ns: int) -> None:
        """Advance the world to `time_ns` under the present coil currents."""
        if time_ns <= self.time_ns:
            return
        self._acting = self._currents()
        if not self._held:
            span, acting = (time_ns - self.time_ns) * 1e-9, self._acting
            self.energy += span * float(np.dot(self._supply.resistance, acting * acting))
            self.supply_energy += span * self._supply.voltage * float(np.abs(acting).sum())
        self.time_ns = time_ns
        since = time_ns - self._start_ns
        while self._stepped_ns + STEP_NS <= since:
            if self._held and self._start_ns + self._stepped_ns >= self._release_ns:
                self._held = False
                self._scenario.set_rotation(self._attitude, self._tip_off)
            self._step(since)

    def motion(self, time_ns: int) -> BodyMotion:
        """Advance to `time_ns` and return the motion, whose specific force is zero in free fall."""
        self.advance_to(time_ns)
        attitude, rate = self._attitude, np.zeros(3)
        if not self._held:
            state = self._scenario.craft.scStateOutMsg.read()
            rate = np.array(state.omega_BN_B)
            turn = quaternion.from_rotation_vector(rate * self._behind())
            attitude = quaternion.multiply(turn, _of_rodrigues(np.array(state.sigma_BN)))
        field = quaternion.attitude_matrix(attitude) @ self._field()
        return BodyMotion(self.time_ns, attitude, rate, field, np.zeros(3))

    def surroundings(self) -> OrbitEnvironment:
        """Return the environment of the craft at the present time."""
        state = self._scenario.craft.scStateOutMsg.read()
        velocity = np.array(state.v_BN_N)
        position = np.array(state.r_BN_N) + velocity * self._behind()
        away = sun_position(self._date()) - position
        distance = float(np.linalg.norm(away))
        seen = float(self._scenario.shadow.eclipseOutMsgs[0].read().shadowFactor)
        return OrbitEnvironment(
            _floats(position),
            _floats(velocity),
            _floats(self._field()),
            _floats(away / distance),
            seen * (ASTRONOMICAL_UNIT / distance) ** 2,
            seen,
            float(self._scenario.air.envOutMsgs[0].read().neutralDensity),
            (0.0, 0.0, 0.0),
        )

    def utc_ns(self) -> int:
        """Return the present UTC, ns since 1970."""
        return self._utc_start_ns + self.time_ns - self._start_ns

    def truth(self) -> WorldTruth:
        """Return the present coil currents and the energies so far."""
        return WorldTruth(self._acting, self.energy, self.supply_energy)

    def orbit_truth(self) -> OrbitTruth:
        """Return the present state without torques, which Basilisk does not provide separately."""
        motion, around = self.motion(self.time_ns), self.surroundings()
        return OrbitTruth(
            current=self._acting,
            energy=self.energy,
            supply_energy=self.supply_energy,
            utc=utc_date(self),
            quaternion=motion.quaternion,
            rate=motion.rate,
            position=np.array(around.position),
            velocity=np.array(around.velocity),
            field=np.array(around.field),
            sun=np.array(around.sun),
            sunlit=around.sunlit,
            residual_dipole=self._residual(),
            torques=dict,
        )

    def _step(self, until_ns: int) -> None:
        """Run all steps up to `until_ns`, the release or the next whole second, whichever is earliest."""
        ends = min(until_ns, (self._stepped_ns // SECOND_NS + 1) * SECOND_NS)
        if self._held and self._release_ns < NEVER:
            ends = min(ends, max(self._stepped_ns + STEP_NS, self._release_ns - self._start_ns))
        steps = max(1, (ends - self._stepped_ns) // STEP_NS)
        if self._stepped_ns - self._placed_ns >= SECOND_NS:
            self._placed_ns = self._stepped_ns
            self._scenario.place_bodies(self._date(), self._stepped_ns)
        dipole = _floats(self.craft.coil_dipole @ self._acting + self._residual())
        self._scenario.set_dipole(dipole, self._stepped_ns)
        self._stepped_ns += steps * STEP_NS
        self._scenario.run_to(self._stepped_ns)

    def _residual(self) -> FloatArray:
        light = float(self._scenario.shadow.eclipseOutMsgs[0].read().shadowFactor)
        return np.asarray(self.craft.constant_dipole + light * self.craft.sunlit_dipole)

    def _field(self) -> FloatArray:
        return np.array(self._scenario.field.envOutMsgs[0].read().magField_N)

    def _behind(self) -> float:
        """Return the time (s) since the last integration step of Basilisk."""
        return (self.time_ns - self._start_ns - self._stepped_ns) * 1e-9

    def _date(self) -> float:
        return UNIX_EPOCH + (self._utc_start_ns + self._stepped_ns) * 1e-9 / DAY


def _scenario() -> type[BasiliskScenario]:
    try:
        from sim_hal.worlds.basilisk.scenario import BasiliskScenario  # noqa: PLC0415 - seven seconds, and optional
    except ImportError as error:
        problem = f"needs Basilisk ({error}): pip install 'knightcube-flight[worlds]'"
        raise ConfigError("simulation.world", problem) from error
    return BasiliskScenario


def _of_rodrigues(parameters: FloatArray) -> FloatArray:
    """Return the quaternion (4,) that corresponds to modified Rodrigues parameters (3,)."""
    square = float(parameters @ parameters)
    return np.append(2.0 * parameters, 1.0 - square) / (1.0 + square)


def _floats(vector: FloatArray) -> Floats:
    x, y, z = vector.tolist()
    return x, y, z


def make(inputs: WorldInputs) -> BasiliskWorld:
    """Return the Basilisk world of a configuration.

    Raises ConfigError if the section `simulation.free_body` or Basilisk is missing.
    """
    return BasiliskWorld(*body_inputs(inputs, "this world"))
