"""The testbed: a rigid body on a thread in a Helmholtz coil's field, controlled by its torque coils.

Sease 2013 ch. 5: one degree of freedom, the angle theta about the thread; J theta'' = m x B about the thread
- k theta - c theta'. The testbed frame T has y down along the thread and the field along -z; at theta = 0 the
body axes are those of T, so the coil on body x gives n A B I cos(theta) (5.4), the one on body z
n A B I sin(theta), and the one on body y, which lies along the thread, none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flight.schema.document import ConfigError
from flight.schema.testbed import TestbedConfig, as_testbed
from knightcube.astro.arrays import FloatArray
from sim_hal.settings import Simulation
from sim_hal.worlds.world import BodyMotion, WorldInputs, WorldTruth, about_thread

VACUUM_PERMEABILITY = 4e-7 * math.pi
"""Vacuum permeability (T m/A), with the value of the thesis."""


def helmholtz_field(turns: float, current: float, radius: float) -> float:
    """Return the field (T) at the centre of two coils of `turns` each; `current` in A, `radius` in m."""
    return math.pow(0.8, 1.5) * VACUUM_PERMEABILITY * turns * current / radius


_LONGEST_STEP = 0.025
"""Longest step of the integration (s)."""


@dataclass(frozen=True, slots=True)
class TestbedModel:
    """The true constants of the testbed, SI.

    Attributes:
        inertia: kg m^2, about the thread.
        dipole_per_ampere: n A of each coil, m^2.
        field: T, horizontal.
        stiffness: N m/rad, of the thread.
        damping: N m s/rad, of thread and air.
        resistance: (3,) ohm, of the coils.
        supply_voltage: V across a coil that is fully on.
    """

    __test__ = False  # for pytest: this is not a test

    inertia: float
    dipole_per_ampere: float
    field: float
    stiffness: float
    damping: float
    resistance: tuple[float, float, float]
    supply_voltage: float


class Testbed:
    """The state of the testbed, advanced in time under the coil currents."""

    __test__ = False

    def __init__(
        self,
        model: TestbedModel,
        angle: float,
        release_rate: float,
        currents: Callable[[], FloatArray],
        start_ns: int = 0,
    ) -> None:
        """Hold the body at `angle` rad until it is released with `release_rate` rad/s."""
        self._model = model
        self._currents = currents
        self._release_rate = release_rate
        self._release_ns: int | None = None
        self._held = True
        self.time_ns = start_ns
        self.angle = angle
        self.rate = 0.0
        self.energy = 0.0
        self.supply_energy = 0.0
        self.mean_current: FloatArray = np.zeros(3)

    def release_at(self, time_ns: int) -> None:
        """Release the body at `time_ns`, now or later."""
        self._release_ns = time_ns

    def advance_to(self, time_ns: int) -> None:
        """Advance the state to `time_ns` under the present currents, by classical Runge-Kutta."""
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
        """Advance to `time_ns` and return the motion; `time_ns` must not be before the present state."""
        self.advance_to(time_ns)
        return about_thread(self.time_ns, self.angle, self.rate, self._model.field)

    def truth(self) -> WorldTruth:
        """Return currents and energies of the present state."""
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
    """Return the testbed of a configuration. Raises ConfigError without a release."""
    model, angle, rate = model_of(as_testbed(inputs.config), inputs.section)
    return Testbed(model, angle, rate, inputs.currents, inputs.start_ns)


def model_of(config: TestbedConfig, section: Simulation) -> tuple[TestbedModel, float, float]:
    """Return the true constants, and angle (rad) and rate (rad/s) of the release.

    Values of `section` override those of `config`. Raises ConfigError without a release.
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
