"""Tests that the rigid body of the filter obeys Euler's equations, and has correct derivatives."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    Quaternion,
    Vector,
    compose,
    exponential,
)
from knightcube.errors import UsageError
from knightcube.gnc.estimation.estimate import SIZE, FilterState, Parameters
from knightcube.gnc.estimation.rigid_body import (
    ProcessNoise,
    RigidBody,
    _propagated,
    _rate_change,
    propagate,
)
from knightcube.gnc.guidance.plant import SingleAxisPlant
from tests.knightcube.gnc.estimation.flights import FREE
from tests.support.compiled_forms import assert_forms_agree
from tests.support.consistency_worlds import DIPOLE, INERTIA, TESTBED_FIELD

SKEWED: FloatArray = np.array([[1.1, 0.05, -0.03], [0.05, 1.05, 0.02], [-0.03, 0.02, 0.99]]) * 1e-3
Q: Quaternion = compose(exponential(0.4, -0.7, 0.2), exponential(0.1, 0.3, 1.1))
RATE: Vector = (0.3, -0.2, 0.5)
CURRENTS: FloatArray = np.array([0.1, -0.05, 0.12])
FIELD: FloatArray = np.array([1e-4, -2e-4, 4e-4])


def acceleration(body: RigidBody, q: Quaternion, rate: Vector, currents: FloatArray) -> FloatArray:
    return np.array(body.linearise(q, rate, body.parameters, body.torquing(currents), 0.0).acceleration)


@given(st.floats(-1.5, 1.5), st.floats(-1.0, 1.0), st.floats(-0.15, 0.15))
def test_a_suspended_body_accelerates_like_the_single_axis_plant(
    angle: float, rate: float, amps: float
) -> None:
    body = RigidBody(INERTIA, DIPOLE, TESTBED_FIELD, suspended=True, stiffness=1e-5, damping=2e-6)
    plant = SingleAxisPlant(float(INERTIA[1, 1]), DIPOLE * 4.5e-4, 23.0, 0.148, 1e-5, 2e-6)
    x, y, z = acceleration(body, exponential(0.0, angle, 0.0), (0.0, rate, 0.0), np.array([amps, 0.1, 0.0]))
    assert (x, z) == (0.0, 0.0)
    assert y == pytest.approx(plant.acceleration(angle, rate, amps), abs=1e-14)


def test_a_free_body_obeys_eulers_equation() -> None:
    body = RigidBody(SKEWED, DIPOLE, FIELD)
    field_body = quaternion.attitude_matrix(np.array(Q)) @ FIELD
    torque = np.cross(DIPOLE * CURRENTS, field_body) - np.cross(RATE, SKEWED @ RATE)
    expected = np.linalg.solve(SKEWED, torque)
    np.testing.assert_allclose(acceleration(body, Q, RATE, CURRENTS), expected, rtol=1e-12)


@pytest.mark.parametrize("suspended", [False, True])
def test_the_derivatives_of_a_body_are_those_of_its_acceleration(suspended: bool) -> None:
    thread = {"stiffness": 1e-5, "damping": 2e-6} if suspended else {}
    body = RigidBody(SKEWED, DIPOLE, FIELD, suspended, **thread)
    # For a rotation about another axis than the suspension thread, the twist changes at a different rate.
    q = exponential(0.0, 0.7, 0.0) if suspended else Q
    model = body.linearise(q, RATE, body.parameters, body.torquing(CURRENTS), 0.0)
    step = 1e-6
    for axis in [1] if suspended else range(3):
        bump = step * np.eye(3)[axis]
        turned = acceleration(body, compose(exponential(*bump), q), RATE, CURRENTS)
        back = acceleration(body, compose(exponential(*-bump), q), RATE, CURRENTS)
        np.testing.assert_allclose(model.by_attitude[:, axis], (turned - back) / (2 * step), atol=1e-8)
        up, down = np.array(RATE) + bump, np.array(RATE) - bump
        faster = acceleration(body, q, (up[0], up[1], up[2]), CURRENTS)
        slower = acceleration(body, q, (down[0], down[1], down[2]), CURRENTS)
        np.testing.assert_allclose(model.by_rate[:, axis], (faster - slower) / (2 * step), atol=1e-8)
        more = acceleration(body, q, RATE, CURRENTS + bump) - acceleration(body, q, RATE, CURRENTS)
        np.testing.assert_allclose(model.by_current[:, axis], more / step, atol=1e-8)


def test_the_torque_of_the_thread_is_proportional_to_rotation_and_rate() -> None:
    body = RigidBody(INERTIA, DIPOLE, TESTBED_FIELD, suspended=True)
    hung, rate = exponential(0.0, 0.4, 0.0), (0.0, 0.5, 0.0)
    model = body.linearise(hung, rate, Parameters(0.01, 0.002), body.torquing(np.zeros(3)), 0.0)
    assert model.acceleration[1] == pytest.approx(-0.004 - 0.001)
    assert model.by_parameters[1] == pytest.approx((-0.4, -0.5, 0.0))


def test_a_command_may_bring_its_own_field() -> None:
    there = FREE.torquing(CURRENTS, FIELD)
    assert there.field == tuple(FIELD)
    assert FREE.torquing(CURRENTS).field == tuple(TESTBED_FIELD)
    assert FREE.torquing(np.array([0.1, 0.0, -0.1])).driven == (True, False, True)


@pytest.mark.parametrize(
    ("inertia", "changes"),
    [
        (-INERTIA, {}),
        (INERTIA + np.diag([1e-4, 0.0], 1), {}),
        (np.eye(2), {}),
        (np.diag([1.0, 1.0, 2.1]), {}),
        (1e-8 * np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), {}),
        (INERTIA, {"dipole_per_ampere": math.nan}),
        (INERTIA, {"field": np.array([0.0, math.inf, 0.0])}),
        (INERTIA, {"stiffness": -1.0, "suspended": True}),
        (INERTIA, {"stiffness": 1e-5}),
    ],
)
def test_impossible_properties_of_a_body_are_refused(inertia: FloatArray, changes: dict[str, float]) -> None:
    arguments = {"dipole_per_ampere": DIPOLE, "field": TESTBED_FIELD} | changes
    with pytest.raises(UsageError):
        RigidBody(inertia, **arguments)  # type: ignore[arg-type]  # a table of mistakes


@pytest.mark.parametrize("suspended", [False, True])
def test_the_steps_of_the_loop_forms_equal_those_of_the_numpy_forms(suspended: bool) -> None:
    """Two propagation steps with a stored attitude and the rate change between two commands are compared."""
    rng = np.random.default_rng(61)
    body = RigidBody(SKEWED, DIPOLE, FIELD, suspended)
    q = exponential(0.0, 0.7, 0.0) if suspended else Q
    root, (x, y, z) = rng.normal(0.0, 0.1, (22, 22)), rng.normal(0.0, 0.01, 3).tolist()
    driven, idle = body.torquing(CURRENTS), body.torquing(np.zeros(3))
    motion = body.constants, q, RATE, (x, y, z), (0.01, 0.002, 0.9)
    covariance, density, walks = root @ root.T, np.diag([1e-6, 2e-6, 3e-6]), rng.uniform(0.0, 1e-6, 19)
    for torquing, currents in ((driven, (1e-2, 2e-2, 3e-2)), (idle, (0.0, 0.0, 0.0))):
        coils = torquing.dipole, torquing.field
        noise = currents, density, walks
        assert_forms_agree(_propagated, *motion, *coils, *noise, covariance, 0.02, 2, relative=1e-12)
        assert_forms_agree(_rate_change, *motion, *coils, idle.dipole, idle.field, covariance, relative=1e-12)


def test_a_fast_tumble_is_integrated_as_accurately_as_a_slow_one() -> None:
    """A rod that tumbles at 1 rad/s keeps its angular momentum in inertial axes within 1e-4 over 40 s."""
    inertia = np.diag([0.2, 0.198, 0.004])
    body = RigidBody(inertia, 0.0, FIELD)
    state = FilterState((0.0, 0.0, 0.0, 1.0), (0.3, -0.2, 0.9), _NONE, _NONE, body.parameters)
    noise = ProcessNoise(0.0, np.zeros((3, 3)), np.zeros(SIZE))
    start = inertia @ state.rate
    later, _ = propagate(body, noise, state, np.zeros((SIZE, SIZE)), body.torquing(np.zeros(3)), 40.0)
    end = quaternion.attitude_matrix(np.array(later.quaternion)).T @ inertia @ later.rate
    assert np.linalg.norm(end - start) < 1e-4 * np.linalg.norm(start)
    energy = [0.5 * float(np.array(rate) @ inertia @ rate) for rate in (state.rate, later.rate)]
    assert energy[1] == pytest.approx(energy[0], rel=1e-4)


def test_an_absurd_rate_does_not_make_the_propagation_slow() -> None:
    """The number of steps is limited; at 1e9 rad/s, steps of 0.01 rad would take hours."""
    body = RigidBody(np.diag([0.01, 0.01, 0.01]), 0.0, FIELD)
    state = FilterState((0.0, 0.0, 0.0, 1.0), (1e9, 0.0, 0.0), _NONE, _NONE, body.parameters)
    noise = ProcessNoise(0.0, np.zeros((3, 3)), np.zeros(SIZE))
    later, _ = propagate(body, noise, state, np.zeros((SIZE, SIZE)), body.torquing(np.zeros(3)), 0.025)
    assert later.rate[0] == pytest.approx(1e9)


_NONE: Vector = (0.0, 0.0, 0.0)
