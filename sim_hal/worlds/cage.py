"""The testbed in a Helmholtz cage that reproduces the magnetic field along an orbit.

The true field is IGRF-14 with a ring current along an orbit under J2, in the local frame whose y axis is the
axis of the thread. The cage produces the components normal to the thread, multiplied by its scale and the
gain of its coils. `flight.bodies.testbed.control` is the model of the flight software.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from flight.schema.document import ConfigError
from flight.schema.testbed import as_testbed
from knightcube.astro.arrays import FloatArray
from sim_hal.settings import CageTruth, Disturbances
from sim_hal.worlds.orbit import Environment, elements, julian_date
from sim_hal.worlds.testbed import Testbed, TestbedModel, model_of
from sim_hal.worlds.world import BodyMotion, WorldInputs

_STREAM = 0xCA6E


class OrbitField:
    """The field of the cage, reference axes."""

    def __init__(self, section: CageTruth, scale: float, utc: str, seed: int) -> None:
        date = julian_date(utc)
        generator = np.random.default_rng([seed, _STREAM])
        multiples = Disturbances(ring_current=section.ring_current)
        self._environment = Environment(elements(section.orbit, date), date, generator, multiples)
        self._scale = scale * section.gain

    def at(self, seconds: float) -> tuple[float, float]:
        """Return the components along x and z, T, at a time since the start."""
        position, velocity, field = (np.array(vector) for vector in self._environment.at(seconds)[:3])
        down = -position / np.linalg.norm(position)
        across = np.cross(velocity, position)
        ahead = np.cross(across / np.linalg.norm(across), down)
        return self._scale * float(field @ ahead), self._scale * float(field @ down)


class CagedTestbed(Testbed):
    """The testbed with the field of the cage instead of the constant one."""

    def __init__(
        self,
        model: TestbedModel,
        angle: float,
        release_rate: float,
        currents: Callable[[], FloatArray],
        field: OrbitField,
        start_ns: int = 0,
    ) -> None:
        """Hold the body at `angle` rad until it is released with `release_rate` rad/s."""
        super().__init__(model, angle, release_rate, currents, start_ns)
        self._orbit, self._start_ns = field, start_ns
        self._bx, self._bz = field.at(0.0)

    def advance_to(self, time_ns: int) -> None:
        """Advance the state to `time_ns`; the field is constant during the few ms of an advance."""
        if time_ns > self.time_ns:
            self._bx, self._bz = self._orbit.at((time_ns - self._start_ns) * 1e-9)
        super().advance_to(time_ns)

    def motion(self, time_ns: int) -> BodyMotion:
        """Advance to `time_ns` and return the motion there."""
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


def make(inputs: WorldInputs) -> CagedTestbed:
    """Return the caged testbed of a configuration. Raises ConfigError without its sections."""
    config, section = as_testbed(inputs.config), inputs.section
    if config.cage is None or section.cage is None:
        missing = "cage" if config.cage is None else "simulation.cage"
        raise ConfigError(missing, "is missing: the world cage needs it")
    model, angle, rate = model_of(config, section)
    field = OrbitField(section.cage, config.cage.scale, section.utc, section.seed)
    return CagedTestbed(model, angle, rate, inputs.currents, field, inputs.start_ns)
