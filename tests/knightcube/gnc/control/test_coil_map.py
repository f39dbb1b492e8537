"""Tests of the currents for dipole moments and torques, for coils with any axes and dipole per current."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog, minimize

from knightcube.astro.arrays import FloatArray
from knightcube.errors import KnightCubeError, UsageError
from knightcube.gnc.control.coil_map import CoilMap, allocate, coil_field, limited

TILTED = np.array([[0.8, 0.2, 0.0], [0.1, 0.5, 0.3], [0.0, 0.0, 0.2]])
LIMITS = np.array([0.1, 0.2, 0.3])
OHMS = np.array([10.0, 20.0, 30.0])


def test_currents_make_the_wanted_dipole_and_cost_the_stated_heat() -> None:
    coils = CoilMap(TILTED, LIMITS, OHMS)
    wanted = np.array([0.01, -0.02, 0.03])
    currents = coils.currents(wanted)
    np.testing.assert_allclose(TILTED @ currents, wanted)
    np.testing.assert_allclose(coils.dipole(currents), wanted)
    assert wanted @ coils.heat @ wanted == pytest.approx(float(OHMS @ currents**2))
    np.testing.assert_allclose(coils.per_dipole(TILTED), np.eye(3), atol=1e-12)


def test_equal_coils_along_the_body_axes_are_scaled_exactly() -> None:
    coils = CoilMap.equal(0.648, 0.148, 23.0)
    wanted = np.array([0.01, -0.02, 0.03])
    assert coils.currents(wanted).tolist() == (wanted / 0.648).tolist()
    assert coils.limits.tolist() == [0.648 * 0.148] * 3
    np.testing.assert_allclose(coils.heat, 23.0 / 0.648**2 * np.eye(3))


@given(st.integers(0, 10_000), st.just(3))
def test_every_dipole_within_the_limits_is_feasible_and_the_limits_enclose_the_largest_volume(
    seed: int, count: int
) -> None:
    generator = np.random.default_rng(seed)
    dipoles = generator.standard_normal((3, count))
    if np.linalg.svd(dipoles / np.linalg.norm(dipoles, axis=0), compute_uv=False)[-1] < 0.1:
        return
    limits = generator.uniform(0.1, 1.0, count)
    coils = CoilMap(dipoles, limits, np.ones(count))
    corners = np.array(list(itertools.product([-1.0, 1.0], repeat=3))) * coils.limits
    used = np.array([np.abs(coils.currents(corner)) / limits for corner in corners])
    assert used.max() == pytest.approx(1.0)
    # The box of limits has the largest volume: a box that is longer along one axis, and shorter along another
    # by the same factor, is not feasible.
    for grow, shrink in itertools.permutations(range(3), 2):
        factor = np.ones(3)
        factor[grow], factor[shrink] = 1.05, 1.0 / 1.05
        other = max(np.abs(coils.currents(corner * factor) / limits).max() for corner in corners)
        assert other > 0.999


@pytest.mark.parametrize(("seed", "count"), [(1, 4), (2, 4), (3, 5), (4, 6), (5, 6)])
def test_redundant_coils_share_a_dipole_with_the_least_heat_within_their_limits(
    seed: int, count: int
) -> None:
    """The feasible dipoles agree with linear programming, and the heat agrees with a general optimiser."""
    generator = np.random.default_rng(seed)
    dipoles = generator.standard_normal((3, count))
    limits, ohms = generator.uniform(0.05, 1.0, count), generator.uniform(5.0, 60.0, count)
    coils = CoilMap(dipoles, limits, ohms)
    bounds = [(-limit, limit) for limit in limits]
    reached = []
    for signs in itertools.product([-1.0, 1.0], repeat=3):
        corner = np.array(signs) * coils.limits
        wanted = 0.98 * corner
        currents = coils.currents(wanted)
        np.testing.assert_allclose(dipoles @ currents, wanted, atol=1e-6)
        assert (np.abs(currents) <= limits * (1.0 + 1e-9)).all()
        best = minimize(
            lambda i: ohms @ i**2,
            0.9 * currents,
            jac=lambda i: 2.0 * ohms * i,
            bounds=bounds,
            constraints={"type": "eq", "fun": lambda i, m=wanted: dipoles @ i - m, "jac": lambda _: dipoles},
            method="SLSQP",
            options={"ftol": 1e-12, "maxiter": 300},
        )
        assert best.success
        assert ohms @ currents**2 <= best.fun * (1.0 + 1e-5)
        # Find the largest multiple of the dipole `corner` (3,) that the coils can generate. The last unknown
        # is this multiple.
        matrix = np.column_stack([dipoles, -corner])
        found = linprog([0.0] * count + [-1.0], A_eq=matrix, b_eq=np.zeros(3), bounds=[*bounds, (0.0, None)])
        reached.append(-found.fun)
    assert min(reached) == pytest.approx(1.0, abs=1e-3)


def test_a_weak_limit_is_relieved_by_a_parallel_coil() -> None:
    dipoles = np.column_stack([np.eye(3), [0.0, 0.0, 1.0]])
    coils = CoilMap(dipoles, np.array([0.1, 0.1, 0.02, 0.1]), np.full(4, 20.0))
    np.testing.assert_allclose(coils.limits, [0.1, 0.1, 0.12], rtol=1e-9)
    np.testing.assert_allclose(
        coils.currents(np.array([0.0, 0.0, 0.03])), [0.0, 0.0, 0.015, 0.015], atol=1e-12
    )
    np.testing.assert_allclose(coils.currents(np.array([0.0, 0.0, 0.1])), [0.0, 0.0, 0.02, 0.08], atol=1e-9)
    assert coils.heat[2, 2] == pytest.approx(10.0)


def test_the_coils_that_work_have_their_own_limits_and_heat() -> None:
    pyramid = np.array([[1.0, -1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0], [1.0, 1.0, 1.0, 1.0]])
    coils = CoilMap(pyramid, np.full(4, 0.1), np.full(4, 30.0))
    assert coils.working(np.ones(4, dtype=bool)) is coils
    left = coils.working(np.array([True, True, False, True]))
    expected = CoilMap(pyramid[:, [0, 1, 3]], np.full(3, 0.1), np.full(3, 30.0))
    np.testing.assert_allclose(left.heat, expected.heat)
    np.testing.assert_allclose(left.limits, expected.limits)
    assert np.linalg.eigvalsh(left.heat - coils.heat).min() > -1e-12, "the same dipoles heat more"
    # With two coils, the dipole normal to both coils is assigned half of the limit.
    pair = CoilMap.equal(0.6, 0.1, 20.0).working(np.array([True, False, True]))
    np.testing.assert_allclose(pair.limits, [0.06, 0.03, 0.06])
    np.testing.assert_allclose(np.diag(pair.heat), 20.0 / np.array([0.6, 0.3, 0.6]) ** 2)
    with pytest.raises(UsageError, match=r"all coils lie along \[0.00, 1.00, 0.00\]"):
        CoilMap.equal(0.6, 0.1).working(np.array([False, True, False]))
    with pytest.raises(UsageError, match="no coil works"):
        CoilMap.equal(0.6, 0.1).working(np.zeros(3, dtype=bool))


def test_the_linear_shares_of_coils_are_those_of_the_allocation_below_the_limits() -> None:
    pyramid = np.array([[1.0, -1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0], [1.0, 1.0, 1.0, 1.0]])
    coils = CoilMap(pyramid, np.full(4, 0.1), np.array([10.0, 20.0, 30.0, 40.0]))
    every, three = np.ones(4, dtype=bool), np.array([True, True, False, True])
    wanted = np.array([0.01, -0.02, 0.03])
    linear = coils.currents(wanted)
    np.testing.assert_allclose(coils.linear_shares(every) @ linear, linear)
    other = linear + 0.01 * np.array([1.0, -1.0, 1.0, -1.0])  # currents with the same dipole
    np.testing.assert_allclose(coils.linear_shares(every) @ other, linear)
    shared = coils.linear_shares(three) @ other
    assert shared[2] == 0.0
    np.testing.assert_allclose(pyramid @ shared, wanted)


def test_the_covariance_of_redundant_coils_is_that_of_drawn_errors() -> None:
    pyramid = np.array([[1.0, -1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0], [0.7, 0.7, 0.7, 0.7]])
    coils = CoilMap(pyramid, np.full(4, 0.1), np.array([10.0, 20.0, 30.0, 40.0]))
    generator = np.random.default_rng(8)
    drawn = []
    for _ in range(4000):
        gains = np.array([0.1, 0.1, 0.1, 0.3]) * generator.uniform(-1.0, 1.0, 4)
        drawn.append((coils.per_dipole(pyramid * (1.0 + gains)) - np.eye(3)).ravel())
    spread = coils.error_covariance(np.array([0.1, 0.1, 0.1, 0.3]), 0.0)
    np.testing.assert_allclose(np.cov(np.array(drawn).T), spread, atol=0.06 * np.abs(spread).max())


def test_coils_in_a_plane_are_refused() -> None:
    flat = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    with pytest.raises(
        UsageError, match=r"lie in one plane and make no dipole along its normal \[-?0.00, -?0.00, -?1.00\]"
    ):
        CoilMap(flat, LIMITS, OHMS)


def test_a_dipole_beyond_a_limit_keeps_its_direction() -> None:
    limits = np.array([0.1, 0.2, 0.4])
    inside = np.array([0.1, -0.2, 0.3])
    assert limited(inside, limits) is inside
    np.testing.assert_allclose(limited(np.array([0.2, -0.8, 0.4]), limits), [0.05, -0.2, 0.1])


def test_the_covariance_of_coils_along_the_body_axes_is_that_of_gain_and_misalignment() -> None:
    coils = CoilMap(np.diag([0.6, 2.0, 0.1]), LIMITS, OHMS)
    assert coils.aligned
    assert not CoilMap(TILTED, LIMITS, OHMS).aligned
    expected = np.where(np.eye(3, dtype=bool), 0.2**2, 0.05**2).ravel() / 3.0
    np.testing.assert_allclose(coils.error_covariance(0.2, 0.05), np.diag(expected), atol=1e-15)


def test_the_field_of_a_coil_is_that_of_a_loop_on_its_axis_and_of_a_dipole_far_away() -> None:
    """On its axis, a coil has the field of a loop, B = mu0 m / (2 pi (a^2 + z^2)^1.5).

    The formula is in Jackson, section 5.5. Far away, the coil has the field of a dipole.
    """
    area, height = 0.0081, 0.04
    moment = 0.648 * np.array([0.6, 0.0, 0.8])
    near = coil_field(moment, height * moment / 0.648, area)
    assert near == pytest.approx(2e-7 * moment / (area / np.pi + height**2) ** 1.5, rel=1e-9)
    offset = np.array([10.0, -20.0, 5.0])
    assert coil_field(moment, offset, area) == pytest.approx(coil_field(moment, offset), rel=1e-3, abs=0.0)
    assert coil_field(moment, np.array([0.8, 0.0, -0.6])) == pytest.approx(-1e-7 * moment, rel=1e-9)


PER_AMPERE = 2.0
COILS = PER_AMPERE * np.eye(3)
FIELD = np.array([2e-5, -1e-5, 3e-5])
AMPLE = np.full(3, 100.0)


def test_three_coils_make_the_torque_across_the_field_with_the_least_dipole() -> None:
    """Three coils make a torque T normal to the field by the smallest dipole, B x T / B^2."""
    torque = np.cross([1e-6, 2e-6, -1e-6], FIELD / np.linalg.norm(FIELD))
    found = allocate(torque, FIELD, COILS, AMPLE)
    assert PER_AMPERE * found.currents == pytest.approx(np.cross(FIELD, torque) / (FIELD @ FIELD))
    assert found.torque == pytest.approx(torque)
    assert np.cross(PER_AMPERE * found.currents, FIELD) == pytest.approx(found.torque)
    assert found.share == pytest.approx(1.0)


def test_no_part_of_a_torque_along_the_field_is_made() -> None:
    found = allocate(1e-2 * FIELD, FIELD, COILS, AMPLE)
    assert found.torque == pytest.approx(np.zeros(3), abs=1e-18)
    assert found.share == pytest.approx(0.0, abs=1e-9)
    # A torque at 45 deg to the field has half of its squared magnitude normal to the field.
    across = np.cross(FIELD, [0.0, 0.0, 1.0])
    mixed = FIELD / np.linalg.norm(FIELD) + across / np.linalg.norm(across)
    assert allocate(1e-6 * mixed, FIELD, COILS, AMPLE).share == pytest.approx(0.5)


def test_a_current_beyond_its_limit_scales_all_of_them() -> None:
    torque = 1e-6 * np.cross([1.0, 2.0, -1.0], FIELD / np.linalg.norm(FIELD))
    full = allocate(torque, FIELD, COILS, AMPLE).currents
    limits = np.abs(full) * np.array([0.5, 0.25, 2.0])
    found = allocate(torque, FIELD, COILS, limits)
    assert found.currents == pytest.approx(0.25 * full)
    assert found.share == pytest.approx(0.25)
    assert found.torque == pytest.approx(0.25 * torque)
    assert allocate(torque, FIELD, COILS, np.abs(full) * 1.01).currents == pytest.approx(full)


def test_two_coils_make_the_same_torque_unless_the_failed_axis_is_normal_to_the_field() -> None:
    torque = 1e-6 * np.cross([1.0, 2.0, -1.0], FIELD / np.linalg.norm(FIELD))
    two = np.array([True, False, True])
    found = allocate(torque, FIELD, COILS, AMPLE, available=two)
    assert found.currents[1] == 0.0
    assert found.torque == pytest.approx(torque)
    flat = np.array([3e-5, 0.0, 4e-5])
    lost = allocate(np.cross([0.0, 1e-6, 0.0], flat / np.linalg.norm(flat)), flat, COILS, AMPLE, two)
    assert lost.torque == pytest.approx(np.zeros(3), abs=1e-15)


@pytest.mark.parametrize(("sine", "kept"), [(0.14, False), (0.17, True)])
def test_a_torque_that_would_take_all_the_current_is_discarded(sine: float, kept: bool) -> None:
    """Without coil y, a torque that would take nearly all the current is discarded.

    The tested fields are at small angles from the x-z plane, whose sines are given.
    """
    field = 3e-5 * np.array([np.sqrt(1.0 - sine**2), sine, 0.0])
    weak = np.array([0.0, 0.0, 1e-8])
    found = allocate(weak, field, COILS, AMPLE, available=np.array([True, False, True]))
    assert (found.share == pytest.approx(1.0)) is kept
    assert (float(np.abs(found.currents).max()) > 0.0) is kept


def test_only_the_torque_about_the_free_axis_is_made() -> None:
    free = np.array([False, True, False])
    found = allocate(np.array([1e-6, 2e-6, -5e-6]), FIELD, COILS, AMPLE, free=free)
    assert found.torque == pytest.approx([0.0, 2e-6, 0.0], abs=1e-18)
    assert found.share == pytest.approx(1.0)
    assert allocate(np.array([1e-6, 0.0, 0.0]), FIELD, COILS, AMPLE, free=free).share == 1.0


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_torque_or_a_field_that_is_not_finite_is_refused(wrong: float) -> None:
    with pytest.raises(KnightCubeError, match="not finite"):
        allocate(np.array([wrong, 0.0, 0.0]), FIELD, COILS, AMPLE)
    with pytest.raises(KnightCubeError, match="not finite"):
        allocate(np.zeros(3), np.array([0.0, wrong, 0.0]), COILS, AMPLE)


def test_redundant_coils_make_a_torque_with_the_least_heat() -> None:
    """Two parallel coils share their dipole in inverse proportion to their resistances.

    This distribution minimises the heat of the coils.
    """
    dipoles = np.column_stack([0.6 * np.eye(3), [0.0, 0.0, 0.6]])
    ohms = np.array([20.0, 20.0, 20.0, 60.0])
    torque = np.cross([0.01, 0.02, 0.03], FIELD)
    found = allocate(torque, FIELD, dipoles, np.full(4, 1e3), resistance=ohms)
    assert found.torque == pytest.approx(torque, rel=1e-9)
    assert found.currents[2] == pytest.approx(3.0 * found.currents[3])
    rng = np.random.default_rng(2)
    effect = np.cross(dipoles.T, FIELD).T
    idle = np.eye(4) - np.linalg.pinv(effect) @ effect  # projects onto currents that cause no torque
    for change in rng.normal(scale=1e-3, size=(20, 4)) @ idle:
        assert ohms @ (found.currents + change) ** 2 > ohms @ found.currents**2


@pytest.mark.parametrize("resistance", [None, np.array([10.0, 10.0, 100.0])])
def test_a_coil_with_few_turns_and_a_large_current_makes_its_torque(resistance: FloatArray | None) -> None:
    """An air coil makes a tenth of the dipole per ampere of two rods, but carries ten times their current."""
    torque, field = np.array([0.0, 5e-6, 0.0]), np.array([3e-5, 0.0, 0.0])
    limits = np.array([0.1, 0.1, 1.0])
    found = allocate(torque, field, np.diag([3.0, 3.0, 0.3]), limits, resistance=resistance)
    np.testing.assert_allclose(found.torque, torque, atol=1e-15)
    assert found.share == pytest.approx(1.0)
    assert found.currents[2] == pytest.approx(5e-6 / (0.3 * 3e-5))


def test_a_coil_with_a_limit_of_zero_is_not_used() -> None:
    torque = np.cross([1e-2, 0.0, 0.0], FIELD)
    found = allocate(torque, FIELD, COILS, np.array([0.0, 10.0, 10.0]))
    assert found.currents[0] == 0.0
    assert found.share > 0.5
    assert allocate(torque, FIELD, COILS, np.zeros(3)).currents.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"current_limits": np.ones(2)}, "current_limits: an array of shape"),
        ({"current_limits": np.array([1.0, 0.0, 1.0])}, "current_limits: .* above zero"),
        ({"resistance": np.array([1.0, -1.0, 1.0])}, "resistance: .* above zero"),
        ({"resistance": np.array([1.0, np.nan, 1.0])}, "resistance: .* finite"),
        ({"dipoles": np.diag([1.0, 1.0, 0.0])}, "dipoles: .* not zero"),
        ({"dipoles": np.ones((2, 3))}, "dipoles: an array of shape"),
    ],
)
def test_impossible_coils_are_refused_with_the_name_of_the_argument(
    changes: dict[str, FloatArray], message: str
) -> None:
    given_coils = {"dipoles": TILTED, "current_limits": LIMITS, "resistance": OHMS}
    with pytest.raises(UsageError, match=message):
        CoilMap(**{**given_coils, **changes})
