"""Tests that a body far from its path is damped, in any attitude, until its rate is low."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest

from knightcube import Goal, PointingTarget, plan_pointing, propagate_elements
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import AIR, CONSTANT, SIZES, pressures, shapes
from knightcube.astro.earth.orbit_knowledge import OrbitError
from knightcube.astro.quaternion import angle_between, attitude_matrix, from_rotation_vector, multiply
from knightcube.errors import ArgumentError, PlanningError, UsageError
from knightcube.gnc.control.pointing_law import (
    DAMPING_TIMEOUT,
    FAR,
    LEAVING,
    SLOW,
    PathRecovery,
    PointingLaw,
    damping_dipole,
)
from knightcube.gnc.control.pointing_table import (
    PointingPreview,
    PointingTable,
    pointing_table,
)
from knightcube.gnc.guidance.attitude_law import approach, references
from tests.knightcube.gnc.control.pointing_cases import (
    INERTIA,
    LAW,
    LIMIT,
    ORBIT,
    RESIDUAL,
    SIZE,
    STEP,
    WEIGHTS,
    pushed,
)


def table_from(start: FloatArray, spin: FloatArray, kept: int, until: float = 9_000.0) -> PointingTable:
    """Return a plan from a rotation error (3,), rad, and a rate error (3,), rad/s."""
    times = np.arange(STEP, until, STEP)
    wanted = references(LAW, ORBIT, times)
    begin = multiply(from_rotation_vector(start), wanted.quaternion[0])
    way = approach(LAW, begin, wanted.rate[0] + spin, STEP, STEP + 500.0)
    begun = references(way, ORBIT, times[: kept + 1])
    field, position = ORBIT.field_at(times), ORBIT.position_at(times)
    ahead = PointingPreview(wanted, begun, field, position, pressures(ORBIT, times), SIZE)
    return pointing_table(ahead, INERTIA, LIMIT, WEIGHTS)


@pytest.fixture(scope="module")
def law() -> PointingLaw:
    """Return the nadir law, in an orbit through the dipole's poles, where the field rotates slowest."""
    return PointingLaw(table_from(np.zeros(3), np.zeros(3), 290, until=6_500.0), LIMIT)


def fly(
    law: PointingLaw, start: FloatArray, sizes: FloatArray, residual: FloatArray, seconds: float
) -> FloatArray:
    """Return rotation errors (n, 3), rad, every 10 s, of a body with the torques `SIZE` and `RESIDUAL`."""
    now = law.wanted(STEP)
    q, w = multiply(from_rotation_vector(start), now.quaternion), now.rate
    turns = []
    for time in np.arange(STEP, seconds, STEP):
        at = np.array([time])
        field = attitude_matrix(q) @ ORBIT.field_at(at)[0]
        command = law.command(time, q, w, field, residual, sizes)
        assert np.abs(command.dipole).max() <= LIMIT
        turns.append(command.rotation)
        for part in range(2):
            at = np.array([time + 0.5 * STEP * part])
            q, w = pushed(q, w, attitude_matrix(q), at, command.dipole + RESIDUAL, 0.5 * STEP)
    return np.degrees(turns)


def test_the_law_holds_nadir_and_known_torques_reduce_the_error_below_0_6(law: PointingLaw) -> None:
    known = fly(law, np.zeros(3), SIZE, RESIDUAL, 3000.0)[100:]
    unknown = fly(law, np.zeros(3), np.zeros(SIZES), RESIDUAL, 3000.0)[100:]
    error = [float(np.sqrt(np.mean(np.sum(turns**2, axis=1)))) for turns in (known, unknown)]
    assert error[0] < 2.0
    assert error[0] < 0.6 * error[1]


def test_ten_degrees_of_error_are_removed_within_half_a_revolution(law: PointingLaw) -> None:
    turns = fly(law, np.radians([8.0, -5.0, 4.0]), SIZE, RESIDUAL, 2800.0)
    assert np.linalg.norm(turns[-30:], axis=1).max() < 2.0
    assert np.linalg.norm(turns, axis=1).max() < 30.0


def test_the_dipole_has_no_part_along_the_field_and_cancels_the_residual_across_it(law: PointingLaw) -> None:
    wanted = law.reference(500.0)
    field = np.array([1e-5, -2e-5, 1.5e-5])
    q = multiply(from_rotation_vector(np.array([0.01, -0.02, 0.005])), wanted.quaternion)
    command = law.command(500.0, q, wanted.rate, field, np.zeros(3), np.zeros(SIZES))
    assert abs(command.dipole @ field) < 1e-9 * np.linalg.norm(command.dipole) * np.linalg.norm(field)
    other = law.command(500.0, q, wanted.rate, field, RESIDUAL, np.zeros(SIZES))
    assert abs(other.dipole @ field) < 1e-9 * np.linalg.norm(other.dipole) * np.linalg.norm(field)
    np.testing.assert_allclose(
        np.cross(other.dipole + RESIDUAL, field), np.cross(command.dipole, field), atol=1e-17
    )
    np.testing.assert_allclose(command.rotation, [0.01, -0.02, 0.005], atol=1e-9)


def test_the_shapes_are_constant_with_the_flight_and_with_the_sun() -> None:
    times = np.array([0.0, 1000.0])
    to_body = np.tile(np.eye(3), (2, 1, 1))
    torque = shapes(pressures(ORBIT, times), to_body)
    np.testing.assert_array_equal(torque[:, :, CONSTANT], np.tile(np.eye(3), (2, 1, 1)))
    for k, time in enumerate(times):
        place, flight = ORBIT.position_at(np.array([time]))[0], ORBIT.velocity_at(np.array([time]))[0]
        flight = flight - np.cross([0.0, 0.0, 7.292115e-5], place)  # the atmosphere rotates with the Earth
        np.testing.assert_allclose(torque[k, :, AIR].T @ flight, 0.0, atol=1e-8)
    day, night = (np.linalg.norm(torque[k, :, AIR]) for k in (0, 1))
    assert day > 1.3 * night


def test_a_path_from_upside_down_is_one_that_the_coils_manage_and_ends_in_the_law() -> None:
    """A path from an upside-down attitude ends near the law, and its dipoles alone move the body along it.

    The simulation without feedback lasts ten minutes, and ends within 8 deg of the path.
    """
    table = table_from(np.array([0.0, 2.8, 0.6]), np.radians([0.2, -0.1, 0.1]), 200, until=4_000.0)
    off = np.degrees(angle_between(table.path.quaternion, table.wanted.quaternion))
    assert off[0] == pytest.approx(np.degrees(np.linalg.norm([0.0, 2.8, 0.6])), abs=0.1)
    assert off[-40:].max() < 12.0
    assert np.abs(table.dipole).max() <= LIMIT
    q, w = table.path.quaternion[0], table.path.rate[0]
    for k in range(60):
        for part in range(10):
            turned, at = attitude_matrix(q), np.array([STEP * (k + 1) + part + 0.5])
            q, w = pushed(q, w, turned, at, table.dipole[k], 1.0)
    assert np.degrees(angle_between(q, table.path.quaternion[60])) < 8.0


def test_a_body_on_its_law_flies_no_detour() -> None:
    table = table_from(np.zeros(3), np.zeros(3), 30, until=3_000.0)
    assert np.degrees(angle_between(table.path.quaternion, table.wanted.quaternion)).max() < 3.0


def test_uneven_times_and_a_path_without_preview_are_refused() -> None:
    times = np.array([10.0, 20.0, 40.0, 50.0])
    wanted, field = references(LAW, ORBIT, times), ORBIT.field_at(times)
    position, pressed = ORBIT.position_at(times), pressures(ORBIT, times)
    for begun in (wanted.until(3), wanted):
        ahead = PointingPreview(wanted, begun, field, position, pressed, SIZE)
        with pytest.raises(UsageError, match="equally spaced"):
            pointing_table(ahead, INERTIA, LIMIT, WEIGHTS)


def test_a_body_that_no_step_can_follow_is_refused_and_gives_no_path_that_is_not_finite() -> None:
    with pytest.raises(PlanningError, match="too far in one planning step"):
        table_from(np.zeros(3), np.array([0.5, 0.4, 0.0]), 30, until=1_000.0)


def test_a_path_is_flown_up_to_where_it_turns_too_fast_unless_that_is_soon() -> None:
    table = table_from(np.zeros(3), np.zeros(3), 30)
    limit = 2.0 * table.fastest
    assert table.below(limit) is table

    def with_spike(place: int) -> PointingTable | None:
        rate = table.path.rate.copy()
        rate[place] = [limit, 0.0, 0.0]
        return replace(table, path=replace(table.path, rate=rate)).below(limit)

    at_the_end = with_spike(30)
    assert at_the_end is not None
    assert (len(at_the_end.dipole), len(at_the_end.path.times)) == (29, 30)
    assert at_the_end.fastest < limit
    assert with_spike(5) is None


def test_damping_by_a_full_tensor_is_the_same_in_rotated_body_axes() -> None:
    rng, moments = np.random.default_rng(2), np.diag([1.1e-3, 3.05e-3, 2.2e-3])
    for _ in range(10):
        rate, field = 0.02 * rng.standard_normal(3), 4e-5 * rng.standard_normal(3)
        turn = attitude_matrix(from_rotation_vector(rng.standard_normal(3)))
        rotated = damping_dipole(turn @ moments @ turn.T, turn @ rate, turn @ field)
        np.testing.assert_allclose(rotated, turn @ damping_dipole(moments, rate, field), rtol=1e-9)


def test_damping_takes_energy_from_any_rate_in_any_field() -> None:
    rng, inertia = np.random.default_rng(1), np.diag([1.1e-3, 1.05e-3, 0.99e-3])
    for _ in range(50):
        rate, field = 0.02 * rng.standard_normal(3), 4e-5 * rng.standard_normal(3)
        torque = np.cross(damping_dipole(inertia, rate, field), field)
        # For equal moments of inertia, the power of the damping torque, -J rate normal to the field, is never
        # positive.
        assert float(rate @ torque) < 1e-3 * float(np.linalg.norm(rate) * np.linalg.norm(torque))
        assert (
            abs(float(torque @ field)) < 1e-12 * float(np.linalg.norm(torque) * np.linalg.norm(field)) + 1e-24
        )


def damped_since(astray: PathRecovery, off: float, speed: float, now: float) -> tuple[float | None, bool]:
    astray.update(off, speed, now)
    return astray.since, astray.ready


def test_far_from_its_path_a_body_is_damped_until_it_is_slow() -> None:
    astray = PathRecovery()
    assert damped_since(astray, 0.99 * FAR, 1.0, 0.0) == (None, False)
    assert damped_since(astray, 1.01 * FAR, 2.0 * SLOW, 10.0) == (10.0, False)
    # The damping continues after the error has become small again.
    assert damped_since(astray, 0.0, 2.0 * SLOW, 20.0) == (10.0, False)
    assert damped_since(astray, 3.0 * FAR, 0.9 * SLOW, 30.0) == (10.0, True)
    astray.planned()
    assert damped_since(astray, 0.0, SLOW, 31.0) == (None, False)


def test_a_spin_along_the_field_is_not_waited_for() -> None:
    astray = PathRecovery()
    astray.update(2.0 * FAR, 5.0 * SLOW, 0.0)
    assert not damped_since(astray, 2.0 * FAR, 5.0 * SLOW, DAMPING_TIMEOUT - 1.0)[1]
    assert damped_since(astray, 2.0 * FAR, 5.0 * SLOW, DAMPING_TIMEOUT + 1.0)[1]


def test_a_body_that_leaves_its_path_is_planned_for_again_while_it_flies_it() -> None:
    astray = PathRecovery()
    for off, leaving in ((0.9 * LEAVING, False), (1.1 * LEAVING, True), (1.1 * FAR, False)):
        astray.update(off, SLOW, 0.0)
        assert astray.leaving == leaving
    astray.planned()
    astray.update(1.1 * LEAVING, SLOW, 1.0)
    astray.planned()
    assert not astray.leaving


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("time", math.nan),
        ("quaternion", np.array([0.0, 0.0, 0.0, 2.0])),
        ("rate", np.full(3, math.nan)),
        ("field", np.array([math.inf, 0.0, 0.0])),
        ("residual_dipole", np.full(3, math.nan)),
    ],
)
def test_the_law_refuses_values_from_which_no_dipole_follows(law: PointingLaw, name: str, value: Any) -> None:
    good: dict[str, Any] = {
        "time": law.span[0],
        "quaternion": law.reference(law.span[0]).quaternion,
        "rate": np.zeros(3),
        "field": np.array([2e-5, 0.0, 1e-5]),
        "residual_dipole": np.array([0.01, 0.02, 0.03]),
        "sizes": np.zeros(SIZES),
    }
    assert law.command(**good).dipole.any()
    assert not law.command(**{**good, "field": np.zeros(3)}).dipole.any()
    with pytest.raises(ArgumentError, match=name):
        law.command(**{**good, name: value})


def test_the_damping_in_a_field_of_zero_is_zero_and_values_that_are_not_finite_are_refused() -> None:
    inertia, rate, field = np.eye(3), np.full(3, 0.01), np.array([0.0, 0.0, 3e-5])
    np.testing.assert_array_equal(damping_dipole(inertia, rate, np.zeros(3)), np.zeros(3))
    for name, given in (("rate", (math.nan * rate, field)), ("field", (rate, math.nan * field))):
        with pytest.raises(ArgumentError, match=name):
            damping_dipole(inertia, *given)


ELEMENTS = (
    "1 99999U 26001A   26079.50000000  .00000000  00000-0  00000+0 0    05",
    "2 99999  97.4640 337.4170 0011973 295.7805  64.3547 15.24067411    09",
)


def test_a_law_that_is_planned_for_elements_begins_at_the_motion_and_approaches_the_target() -> None:
    """The direction to the Earth is that of SGP4, through the public function for elements."""
    start, begin = from_rotation_vector(np.array([0.4, -0.3, 0.2])), datetime(2026, 3, 20, 12, 10, tzinfo=UTC)
    law = plan_pointing(
        inertia=[1.1e-3, 1.05e-3, 0.99e-3],
        dipole_limit=[0.1, 0.1, 0.1],
        elements=ELEMENTS,
        time=begin,
        target=PointingTarget(Goal.NADIR),
        quaternion=start,
        rate=[1e-3, 0.0, 0.0],
        weights=WEIGHTS,
    )
    first, last = law.span
    turned = multiply(from_rotation_vector(first * np.array([1e-3, 0.0, 0.0])), start)
    assert float(angle_between(law.reference(first).quaternion, turned)) < 1e-6
    positions, _ = propagate_elements(ELEMENTS, [begin + timedelta(seconds=s) for s in (first, last)])
    off = [
        math.acos(-float(attitude_matrix(law.reference(s).quaternion)[2] @ p) / float(np.linalg.norm(p)))
        for s, p in zip((first, last), positions, strict=True)
    ]
    assert off[1] < 0.05 < 0.2 * off[0]
    field = np.array([2e-5, 0.0, 3e-5])
    command = law.command(first, turned, np.array([1e-3, 0.0, 0.0]), field)
    given = law.command(first, turned, np.array([1e-3, 0.0, 0.0]), field, np.zeros(3), np.zeros(9))
    np.testing.assert_array_equal(command.dipole, given.dipole)


@pytest.mark.parametrize(
    ("changed", "error", "text"),
    [
        ({"dipole_limit": [0.1, 0.1, 0.0]}, ArgumentError, "dipole_limit: .*above zero"),
        ({"inertia": [1e-3, 1e-3, 3e-3]}, ArgumentError, "inertia: .*principal moments"),
        ({"quaternion": [0, 0, 0, 2]}, ArgumentError, "quaternion: .*length 1"),
        ({"target": PointingTarget(Goal.OBJECT)}, ArgumentError, "target: .*only in flight"),
        ({"across_axis": (0.0, 0.0, 2.0)}, ArgumentError, "across_axis: .*parallel"),
        ({"time": datetime(2027, 3, 20, tzinfo=UTC)}, OrbitError, "days"),
    ],
)
def test_a_law_for_impossible_arguments_is_refused(changed: Any, error: type[Exception], text: str) -> None:
    given: dict[str, Any] = {
        "inertia": INERTIA, "dipole_limit": [0.1] * 3, "elements": ELEMENTS,
        "time": datetime(2026, 3, 20, tzinfo=UTC), "target": PointingTarget(Goal.SUN),
        "quaternion": [0, 0, 0, 1], "rate": [0, 0, 0], "weights": WEIGHTS,
    }  # fmt: skip
    with pytest.raises(error, match=text):
        plan_pointing(**given | changed)
