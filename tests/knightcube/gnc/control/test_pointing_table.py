"""Tests that the path of an orbit is feasible, and rolls if this keeps the pointing axis on the target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import pressures
from knightcube.astro.quaternion import (
    angle_between,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.errors import ArgumentError
from knightcube.gnc.control.pointing_path import (
    RUN_AWAY,
    MotionGains,
    PathConditions,
    PlannedMotion,
    linearised,
    propagate,
)
from knightcube.gnc.control.pointing_table import (
    PointingWeights,
    best_course,
    defects,
    derivative,
    midpoint_step,
    step_costs,
)
from knightcube.gnc.guidance.attitude_law import AttitudeLaw, nadir, references, velocity
from tests.support.circular_orbits import circular

ORBIT = circular(7_500.0)
INERTIA = np.diag([1.10e-3, 1.05e-3, 0.99e-3])
LIMIT, STEP = 0.0959, 10.0
X, Y, Z = np.eye(3)
LAW = AttitudeLaw(Z, nadir, X, velocity).attitudes
SIZES = np.array([0.0, 2e-10, 0.0, -1e-10, 1e-9, 2e-9, 3e-10, 0.0, 2e-10])
"""Torque coefficients (N m) of a KnightCube with a mass offset of 6 mm, from a run of `orbit-pointing`."""
DEAR = PointingWeights(turn=np.radians(1.0), rate=1.0, dipole=3e-4)
CHEAP = replace(DEAR, roll=np.radians(10.0), axis=Z)
BULGED = np.array([4.6e-11, 8.9e-11, -1.1e-10, 3.9e-9, 1.7e-9, 2.35e-9, 3.6e-10, 4.0e-10, 2.2e-10])
"""Torque coefficients (N m) of a run of `orbit-pointing` that is difficult for a KnightCube."""
KEPT = 180


def expected(sizes: FloatArray = SIZES, limit: float = LIMIT) -> PathConditions:
    times = np.arange(STEP, 7_200.0, STEP)
    wanted = references(LAW, ORBIT, times)
    field, position = ORBIT.field_at(times), ORBIT.position_at(times)
    shape = pressures(ORBIT, times)
    return PathConditions(wanted, field, position, shape, sizes, INERTIA, np.linalg.inv(INERTIA), limit)


def course(of: PathConditions, weights: PointingWeights, fastest: float = 0.01) -> PlannedMotion | None:
    found = best_course(of, of.wanted.until(KEPT + 1), *step_costs(weights, STEP), fastest)
    return None if found is None else found[0]


@pytest.fixture(scope="module")
def rolling() -> PlannedMotion:
    found = course(expected(), CHEAP)
    assert found is not None
    return found


def off_axis(motion: PlannedMotion) -> FloatArray:
    """Return the angles (n,) deg between the pointing axis and nadir."""
    wanted = expected().wanted.quaternion
    axes = [attitude_matrix(q).transpose(0, 2, 1) @ Z for q in (motion.quaternion, wanted)]
    cosine = np.sum(axes[0] * axes[1], axis=1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def test_a_small_cost_of_roll_keeps_the_pointing_axis_closer_to_the_target() -> None:
    found = [course(expected(0.3 * SIZES), weights) for weights in (CHEAP, DEAR)]
    rms = [float(np.sqrt(np.mean(off_axis(motion) ** 2))) for motion in found if motion is not None]
    assert rms[0] < 0.5
    assert rms[1] > 4.0 * rms[0]


def test_the_dipoles_of_the_path_alone_move_the_body_along_it(rolling: PlannedMotion) -> None:
    """The dipoles of the path alone move a simulated body along the path for twenty minutes.

    The equations of motion are integrated in steps of 1 s.
    """
    ahead = expected()
    q, w = rolling.quaternion[0], rolling.rate[0]
    for k in range(120):
        control = np.append(rolling.control[k], 0.0)
        for _ in range(10):
            middle = w + 0.5 * ahead.acceleration(k, q, w, control)
            half = multiply(from_rotation_vector(0.5 * w), q)
            w = w + ahead.acceleration(k, half, middle, control)
            q = multiply(from_rotation_vector(middle), q)
    turned = np.degrees(angle_between(rolling.quaternion[120], ahead.wanted.quaternion[120]))
    assert turned > 5.0
    assert np.degrees(angle_between(q, rolling.quaternion[120])) < 0.1 * turned


def test_no_other_motion_near_it_costs_less(rolling: PlannedMotion) -> None:
    """A plan that begins ten minutes later equals the remainder of the first plan, which is thus optimal."""
    whole, later = expected(), 60
    count = len(whole.field)
    rest = replace(
        whole,
        wanted=whole.wanted.since(later),
        field=whole.field[later:],
        position=whole.position[later:],
        pressures=pressures(ORBIT, whole.wanted.times[later:]),
    )
    begun = rolling.references(whole.wanted.times).since(later).until(KEPT + 1)
    found = best_course(rest, begun, *step_costs(CHEAP, STEP), 0.01)
    assert found is not None
    again = found[0].quaternion[: count - later]
    assert np.degrees(angle_between(again, rolling.quaternion[later:])).max() < 0.5


def test_paths_beyond_the_limits_of_dipole_and_rate_are_refused() -> None:
    assert course(expected(limit=1e-6), CHEAP) is None
    assert course(expected(), CHEAP, fastest=1e-3) is None


def test_the_flow_of_an_error_is_the_derivative_of_the_acceleration(rolling: PlannedMotion) -> None:
    """The transition of an error agrees with finite differences of the acceleration.

    A rotation changes the torques of coils, gravity, drag and sunlight.
    """
    ahead, count, size = expected(), 200, 1e-4
    motion = rolling.references(ahead.wanted.times).until(count)
    dipole = rolling.control[:count]
    linear = linearised(
        motion, INERTIA, ahead.field[:count], ahead.position[:count], dipole, ahead.pressed(count)
    )
    for axis in range(3):
        turn = size * np.eye(3)[axis]
        more, less = (
            ahead.accelerations(
                multiply(from_rotation_vector(np.tile(sign * turn, (count, 1))), motion.quaternion),
                motion.rate,
                dipole,
            )
            for sign in (1.0, -1.0)
        )
        slope = (more - less) / (2.0 * size)
        np.testing.assert_allclose(
            linear.transition[:, 3:, axis] / STEP, slope, atol=0.06 * float(np.abs(slope).max())
        )


def test_the_accelerations_are_those_of_one_instant(rolling: PlannedMotion) -> None:
    ahead = expected()
    found = ahead.accelerations(rolling.quaternion[:50], rolling.rate[:50], rolling.control[:50])
    for k in (0, 17, 49):
        control = np.append(rolling.control[k], 0.0)
        one = ahead.acceleration(k, rolling.quaternion[k], rolling.rate[k], control)
        np.testing.assert_allclose(found[k], one, atol=1e-15)


def test_a_path_from_an_attitude_off_the_law_leads_to_the_law() -> None:
    ahead = expected()
    q = multiply(from_rotation_vector(np.radians([6.0, -4.0, 5.0])), ahead.wanted.quaternion[0])
    begun = ahead.wanted.until(KEPT + 1)
    begun = replace(begun, quaternion=np.concatenate([q[None], begun.quaternion[1:]]))
    found = best_course(ahead, begun, *step_costs(CHEAP, STEP), 0.01)
    assert found is not None
    np.testing.assert_allclose(to_rotation_vector(found[0].quaternion[0]), to_rotation_vector(q), atol=1e-12)
    assert off_axis(found[0])[KEPT:].max() < 3.0


@pytest.mark.parametrize("roll", [60.0, -100.0])
def test_a_path_from_an_attitude_far_about_the_axis_is_feasible(roll: float) -> None:
    """From a large roll error, a feasible motion with pointing errors below 25 deg is found.

    With undamped steps and derivatives of the continuous motion, the errors would be 40 deg, or no motion
    would be found.
    """
    ahead = expected(BULGED)
    q = multiply(from_rotation_vector(np.radians([1.0, -1.0, roll])), ahead.wanted.quaternion[0])
    begun = ahead.wanted.until(KEPT + 1)
    begun = replace(begun, quaternion=np.concatenate([q[None], begun.quaternion[1:]]))
    found = best_course(ahead, begun, *step_costs(CHEAP, STEP), 0.01)
    assert found is not None
    assert off_axis(found[0]).max() < 25.0
    lack = np.abs(defects(ahead, found[0])).sum(axis=0)
    assert lack[:3].max() < np.radians(0.1)
    assert lack[3:].max() < 1e-5


def test_the_derivative_of_a_step_is_exact(rolling: PlannedMotion) -> None:
    """The derivative of a step agrees with finite differences, for a body at 2 deg/s or 20 deg per step."""
    ahead, size = expected(), 1e-6
    spun = PlannedMotion(rolling.quaternion, rolling.rate + np.array([0.02, -0.02, 0.02]), rolling.control)
    linear = derivative(ahead, spun)
    for axis in range(9):
        turn, rate, dipole = size * np.eye(9)[axis].reshape(3, 3)
        ends = [
            midpoint_step(
                ahead,
                PlannedMotion(
                    multiply(from_rotation_vector(np.tile(way * turn, (len(spun.rate), 1))), spun.quaternion),
                    spun.rate + way * rate,
                    spun.control + way * dipole,
                ),
            )
            for way in (1.0, -1.0)
        ]
        turned = to_rotation_vector(multiply(ends[0][0], conjugate(ends[1][0])))
        slope = np.concatenate([turned, ends[0][1] - ends[1][1]], axis=1) / (2.0 * size)
        wanted = linear.transition[:, :, axis] if axis < 6 else linear.by_control[:, :, axis - 6]
        for part in (slice(0, 3), slice(3, 6)):
            largest = float(np.abs(wanted[:, part]).max())
            np.testing.assert_allclose(slope[:, part], wanted[:, part], atol=1e-5 * largest)


def test_a_diverging_motion_gives_no_result_and_no_warning() -> None:
    """A motion that diverges gives no result and no warning.

    With the gains of this test, torques along the field accelerate the body more with each step.
    """
    ahead = expected().until(61)
    rest = PlannedMotion(ahead.wanted.quaternion, ahead.wanted.rate, np.zeros((60, 4)))
    gain = np.zeros((60, 4, 6))
    nothing = MotionGains(gain, np.zeros((60, 4, 1)))
    still = propagate(ahead, rest, nothing, 1.0)
    assert still is not None
    assert np.abs(still.rate).max() < 0.01
    for push in (1e2, 1e6, 1e150, 1e300):
        steady = np.zeros((60, 4, 1))
        steady[:, 3] = push * 1e-3
        with np.errstate(all="raise"):
            assert propagate(ahead, rest, MotionGains(gain, steady), 1.0) is None
    steady = np.zeros((60, 4, 1))
    steady[0, 3] = 1e-4
    fast = propagate(ahead, rest, MotionGains(gain, steady), 1.0)
    assert fast is not None, "a motion of several revolutions a step is followed"
    assert 2.0 * np.pi < 10.0 * np.abs(fast.rate).max() < 10.0 * RUN_AWAY


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"turn": 0.0}, "turn: 0.0: give a positive, finite number of rad"),
        ({"dipole": np.nan}, "dipole: nan"),
        ({"fastest": -1.0}, "fastest: -1.0: give a rate above zero"),
        ({"roll": 0.5}, "axis: None: give the body axis"),
        ({"roll": 0.5, "axis": np.zeros(3)}, "axis: .*give a direction"),
    ],
)
def test_weights_without_meaning_are_refused(wrong: dict[str, object], words: str) -> None:
    """Without its axis, the roll would have the same weight as any other rotation."""
    with pytest.raises(ArgumentError, match=words):
        replace(DEAR, **wrong)  # type: ignore[arg-type]
