"""The rotation of a free body against another integrator, invariants and closed forms."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from sim_hal.settings import Disturbances, FreeBodySection, TipOff
from sim_hal.worlds.free_body import FreeBody, Loads, Rotation, State

SECOND = 1_000_000_000
QUIET = Disturbances(drag=0.0, solar_pressure=0.0, residual_dipole=0.0)
FREE = Disturbances(gravity_gradient=0.0, drag=0.0, solar_pressure=0.0, residual_dipole=0.0)
NO_CURRENT = np.zeros(3)


def flown(section: FreeBodySection, seconds: float, currents: FloatArray, step: float = 0.025) -> FreeBody:
    body = FreeBody(section, lambda: currents, seed=3)
    body.release_at(0)
    for k in range(round(seconds / step)):
        body.motion(round((k + 1) * step * SECOND))
    return body


def inertia_matrix(body: FreeBody) -> FloatArray:
    turn = quaternion.attitude_matrix(body.craft.to_principal)
    return np.asarray(turn.T @ np.diag(body.craft.inertia) @ turn)


def independent(
    body: FreeBody, start: FloatArray, currents: FloatArray, seconds: float, loads: bool
) -> FloatArray:
    """Return quaternion and rate (7,) by DOP853, in body axes with a full matrix of inertia."""
    inertia = inertia_matrix(body)

    def slope(time: float, state: FloatArray) -> FloatArray:
        q, w = state[:4], state[4:]
        around = body.environment.at(time)
        turn = quaternion.attitude_matrix(q / np.linalg.norm(q))
        position, field = turn @ around.position, turn @ around.field
        dipole = body.craft.coil_dipole @ currents
        torque = np.zeros(3)
        if loads:
            dipole = dipole + body._loads.residual_dipole(around)
            x, y, z, u, v, p, a, b, c = turn.ravel().tolist()
            drag, sunlight = body._loads.pressures(around, (x, y, z, u, v, p, a, b, c))
            torque = np.add(drag, sunlight)
        pull = 3.0 * GRAVITATIONAL_PARAMETER / np.linalg.norm(position) ** 5
        torque = torque + pull * np.cross(position, inertia @ position) + np.cross(dipole, field)
        change = np.linalg.solve(inertia, torque - np.cross(w, inertia @ w))
        return np.concatenate([quaternion.derivative(q, w), change])

    solved = solve_ivp(slope, (0.0, seconds), start, method="DOP853", rtol=1e-12, atol=1e-13, max_step=1.0)
    return np.asarray(solved.y[:, -1])


@pytest.mark.parametrize("craft", ["knightcube", "cubesat_3u"])
def test_coils_and_gravity_gradient_turn_the_body_as_another_integrator_says(
    craft: Literal["knightcube", "cubesat_3u"],
) -> None:
    section = FreeBodySection(craft=craft, disturbances=QUIET)
    currents = np.array([0.03, -0.02, 0.05])
    still = flown(section, 0.0, currents)
    motion = still.motion(0)
    body = flown(section, 60.0, currents)
    expected = independent(body, np.concatenate([motion.quaternion, still._tip_off]), currents, 60.0, False)
    assert quaternion.angle_between(body.motion(60 * SECOND).quaternion, expected[:4]) < 1e-9
    np.testing.assert_allclose(body.motion(60 * SECOND).rate, expected[4:], atol=1e-10)


def test_loads_held_for_a_tenth_of_a_second_turn_the_body_by_a_microradian_at_most() -> None:
    section = FreeBodySection()
    still = flown(section, 0.0, NO_CURRENT)
    start = np.concatenate([still.motion(0).quaternion, still._tip_off])
    body = flown(section, 60.0, NO_CURRENT)
    expected = independent(body, start, NO_CURRENT, 60.0, True)
    assert 1e-12 < quaternion.angle_between(body.motion(60 * SECOND).quaternion, expected[:4]) < 1e-6


@pytest.mark.parametrize("speed", [0.05, 0.5, 3.0])
def test_without_torque_energy_and_momentum_are_kept(speed: float) -> None:
    section = FreeBodySection(craft="cubesat_3u", disturbances=FREE, release=TipOff(speed=speed))
    body = flown(section, 0.0, NO_CURRENT)
    inertia = inertia_matrix(body)

    def invariants(time: float) -> tuple[float, FloatArray]:
        motion = body.motion(round(time * SECOND))
        momentum = inertia @ motion.rate
        return 0.5 * float(motion.rate @ momentum), quaternion.attitude_matrix(motion.quaternion).T @ momentum

    first_energy, first_momentum = invariants(0.025)
    for time in (10.0, 50.0, 100.0):
        energy, momentum = invariants(time)
        assert energy == pytest.approx(first_energy, rel=1e-9)
        np.testing.assert_allclose(
            momentum, first_momentum, atol=2e-9 * float(np.linalg.norm(first_momentum))
        )


def test_a_body_at_the_stable_attitude_swings_with_the_known_period() -> None:
    """Pitch about the local vertical: omega^2 = 3 n^2 (J_x - J_z) / J_y (Wertz 1978, 18.3)."""
    inertia = (0.0333, 0.0333, 0.0066)
    rotation, n = Rotation(inertia), 1.1e-3
    expected = 2.0 * np.pi / (n * np.sqrt(3.0 * (inertia[0] - inertia[2]) / inertia[1]))
    state: State = (0.0, 1e-3, 0.0, 1.0, 0.0, 0.0, 0.0)
    loads = Loads((0.0, 0.0, 0.0), (0.0, 0.0, np.sqrt(3.0) * n), (0.0, 0.0, 0.0))
    crossings: list[float] = []
    time, dt = 0.0, 1.0
    while len(crossings) < 3:
        after = rotation.step(state, dt, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), loads)
        if after[1] * state[1] < 0.0:
            crossings.append(time + dt * state[1] / (state[1] - after[1]))
        state, time = after, time + dt
    assert crossings[2] - crossings[0] == pytest.approx(expected, rel=1e-5)
