"""Pointing with coils alone: it stays pointed, knows torques ahead, and never exceeds the coils."""

from __future__ import annotations

import numpy as np
import pytest

from flight.gnc.control.three_axes.pointing import PointingLaw
from flight.gnc.control.three_axes.pointing_table import PointingWeights, pointing_table
from flight.gnc.earth.disturbance import AIR, CONSTANT, SIZES, pressures, shapes
from flight.gnc.earth.figure import GRAVITATIONAL_PARAMETER
from flight.gnc.errors import UsageError
from flight.gnc.guidance.three_axes.attitude_law import AttitudeLaw, nadir, references, velocity
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import attitude_matrix, from_rotation_vector, multiply
from tests.flight.gnc.guidance.three_axes.orbits import circular

ORBIT = circular(11_500.0)
INERTIA = np.diag([0.0066, 0.0333, 0.0333])
LIMIT = 0.2
STEP = 10.0
SIZE = np.array([0.0, 0.0, 1e-9, 0.0, -5e-10, 5e-10, 0.0, 0.0, 0.0])
RESIDUAL = np.array([5e-4, -3e-4, 2e-4])
X, Y, Z = np.eye(3)


@pytest.fixture(scope="module")
def law() -> PointingLaw:
    """Nadir along the flight; the orbit lies in the plane of the dipole, where the field turns least."""
    times = np.arange(STEP, 11_400.0, STEP)
    wanted = references(AttitudeLaw(Z, nadir, X, velocity).attitudes, ORBIT, times)
    to_body = np.array([attitude_matrix(q) for q in wanted.quaternion])
    table = pointing_table(
        wanted,
        INERTIA,
        ORBIT.field_at(times),
        ORBIT.position_at(times),
        shapes(pressures(ORBIT, times), to_body),
        PointingWeights(turn=0.02, rate=1.0, dipole=0.003),
    )
    return PointingLaw(table, LIMIT)


def fly(
    law: PointingLaw, start: FloatArray, sizes: FloatArray, residual: FloatArray, seconds: float
) -> FloatArray:
    """Return the turns (n, 3), rad, against the reference, under `SIZE` and `RESIDUAL`; a step of 10 s."""
    now = law.reference(STEP)
    q, w = multiply(from_rotation_vector(start), now.quaternion), now.rate
    inverse, turns = np.linalg.inv(INERTIA), []
    for time in np.arange(STEP, seconds, STEP):
        at = np.array([time])
        field = attitude_matrix(q) @ ORBIT.field_at(at)[0]
        command = law.command(time, q, w, field, residual, sizes)
        assert np.abs(command.dipole).max() <= LIMIT
        turns.append(command.turn)
        for part in range(2):
            at = np.array([time + 0.5 * STEP * part])
            turned = attitude_matrix(q)
            position = turned @ ORBIT.position_at(at)[0]
            radius = float(np.linalg.norm(position))
            torque = 3.0 * GRAVITATIONAL_PARAMETER / radius**5 * np.cross(position, INERTIA @ position)
            torque += np.cross(command.dipole + RESIDUAL, turned @ ORBIT.field_at(at)[0])
            torque += shapes(pressures(ORBIT, at), turned[None])[0] @ SIZE
            w = w + 0.5 * STEP * inverse @ (torque - np.cross(w, INERTIA @ w))
            q = multiply(from_rotation_vector(0.5 * STEP * w), q)
    return np.degrees(turns)


def test_it_holds_nadir_and_torques_known_ahead_cost_less_than_half_the_error(law: PointingLaw) -> None:
    known = fly(law, np.zeros(3), SIZE, RESIDUAL, 3000.0)[100:]
    unknown = fly(law, np.zeros(3), np.zeros(SIZES), RESIDUAL, 3000.0)[100:]
    error = [float(np.sqrt(np.mean(np.sum(turns**2, axis=1)))) for turns in (known, unknown)]
    assert error[0] < 2.0
    assert error[0] < 0.6 * error[1]


def test_ten_degrees_of_error_are_taken_out_within_half_a_revolution(law: PointingLaw) -> None:
    turns = fly(law, np.radians([8.0, -5.0, 4.0]), SIZE, RESIDUAL, 2800.0)
    assert np.linalg.norm(turns[-30:], axis=1).max() < 2.0
    assert np.linalg.norm(turns, axis=1).max() < 30.0


def test_the_dipole_has_no_part_along_the_field_but_the_residual_s_cancellation(law: PointingLaw) -> None:
    wanted = law.reference(500.0)
    field = np.array([1e-5, -2e-5, 1.5e-5])
    q = multiply(from_rotation_vector(np.array([0.01, -0.02, 0.005])), wanted.quaternion)
    command = law.command(500.0, q, wanted.rate, field, np.zeros(3), np.zeros(SIZES))
    assert abs(command.dipole @ field) < 1e-9 * np.linalg.norm(command.dipole) * np.linalg.norm(field)
    other = law.command(500.0, q, wanted.rate, field, RESIDUAL, np.zeros(SIZES))
    np.testing.assert_allclose(other.dipole, command.dipole - RESIDUAL, atol=1e-12)
    np.testing.assert_allclose(command.turn, [0.01, -0.02, 0.005], atol=1e-9)


def test_the_shapes_are_constant_with_the_flight_and_with_the_sun() -> None:
    times = np.array([0.0, 1000.0])
    to_body = np.tile(np.eye(3), (2, 1, 1))
    torque = shapes(pressures(ORBIT, times), to_body)
    np.testing.assert_array_equal(torque[:, :, CONSTANT], np.tile(np.eye(3), (2, 1, 1)))
    for k, time in enumerate(times):
        flight = velocity(ORBIT, np.array([time]))[0]
        np.testing.assert_allclose(torque[k, :, AIR].T @ flight, 0.0, atol=1e-12)
    day, night = (np.linalg.norm(torque[k, :, AIR]) for k in (0, 1))
    assert day > 1.3 * night


def test_uneven_times_are_refused() -> None:
    times = np.array([10.0, 20.0, 40.0])
    wanted = references(AttitudeLaw(Z, nadir, X, velocity).attitudes, ORBIT, times)
    with pytest.raises(UsageError, match="even"):
        pointing_table(
            wanted,
            INERTIA,
            ORBIT.field_at(times),
            ORBIT.position_at(times),
            np.zeros((3, 3, 9)),
            PointingWeights(turn=0.02, rate=1.0, dipole=0.003),
        )
