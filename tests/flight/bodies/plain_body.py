"""A third-party body that a configuration can name: the testbed with its own PD controller."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flight.bodies.testbed.body import TESTBED
from flight.loop.body import BodyKind, CoilCommand, FlightBody, Reference
from flight.loop.facts import Services
from flight.loop.state import Learned
from flight.schema.bodies import as_testbed
from flight.schema.sections import Config
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import conjugate, multiply, to_rotation_vector
from knightcube.gnc.estimation.estimate import Estimate

STIFFNESS, DAMPING = 4e-4, 1e-3
"""Stiffness (N m/rad) and damping (N m s/rad) of the PD controller."""


class PlainTracker:
    """PD control about three axes. The torque is produced by a dipole normal to the field."""

    def __init__(self, field: FloatArray, limit: float, dipole_per_ampere: float) -> None:
        self._field, self._limit, self._dipole_per_ampere = field, limit, dipole_per_ampere

    def command(self, estimate: Estimate, reference: Reference) -> CoilCommand:
        turn = to_rotation_vector(multiply(reference.quaternion, conjugate(estimate.quaternion)))
        torque = STIFFNESS * turn + DAMPING * (reference.body_rate - estimate.rate)
        field = self._field
        dipole = np.cross(field, torque) / (field @ field)
        currents = np.clip(dipole / self._dipole_per_ampere, -self._limit, self._limit)
        return CoilCommand(currents * self._dipole_per_ampere, currents)

    def reset(self) -> None:
        pass


def make(config: Config, services: Services, learned: Mapping[str, Learned]) -> FlightBody:
    testbed = TESTBED.make(config, services, learned)
    field = np.array([0.0, 0.0, -as_testbed(config).plant.field])
    tracker = PlainTracker(field, config.coils.current_limit, float(testbed.control.dipoles[0, 0]))
    testbed.control.tracker = tracker
    return testbed


PLAIN = BodyKind(TESTBED.plan, make)
NO_BODY = 3
