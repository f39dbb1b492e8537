"""Tests that estimated parameters are the prior of the next boot, with variances that increase with age."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from flight.bodies.orbit.body import OrbitView
from flight.bodies.orbit.filter import (
    BODY,
    ERRORS,
    LEARNED_AT,
    PARTS,
    SOURCES,
    UNKNOWN_AGE,
    learned_of,
    start_from,
)
from flight.link import events
from flight.link.events import Mode
from flight.loop.state import Learned, StoredState, decode, encode
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import Knowledge
from knightcube.gnc.estimation.free_filter import (
    DIPOLE,
    GYRO,
    SLOW,
    SUNLIT,
    TORQUES,
    FreeFilter,
    FreeFilterSettings,
    SlowStates,
    density_walk,
)

INERTIA = np.diag([0.0066, 0.0333, 0.0333])
SETTINGS = FreeFilterSettings()
LAYOUT = SETTINGS.error_state(INERTIA)
PRIOR = LAYOUT.prior[SLOW, SLOW]
START, WALK = np.sqrt(PRIOR.diagonal()), np.sqrt(LAYOUT.walks[SLOW])
THEN, CHANGED = 1.78e9, 0.05


def known(share: float = 0.1) -> SlowStates:
    """Return parameters with `share` of their prior standard deviations, and correlated dipole components."""
    sigma = share * START
    together = np.eye(len(sigma))
    dark, lit = DIPOLE.start - GYRO.start, SUNLIT.start - GYRO.start
    together[dark, lit] = together[lit, dark] = -0.8
    return SlowStates(0.5 * START, np.outer(sigma, sigma) * together)


def stored(slow: SlowStates) -> dict[str, Learned]:
    """Return parameters as they are read after they were stored."""
    return decode(encode(1, StoredState(learned=learned_of(slow, THEN)))).state.learned


def variances_after(age: float) -> FloatArray:
    """Return the variances, after an age (s), of parameters whose sigma was a tenth of the prior sigma."""
    return np.asarray(
        (0.1 * START) ** 2 + WALK**2 * age + (CHANGED * START) ** 2 + air_covariance(age).diagonal()
    )


def air_covariance(age: float) -> FloatArray:
    """Return the growth, in `age` s, of the covariance of the torques by changes of the air density."""
    changed, at = np.zeros_like(PRIOR), slice(TORQUES.start - GYRO.start, TORQUES.stop - GYRO.start)
    changed[at, at] = age * density_walk(0.5 * START[at])
    return changed


def test_states_come_back_with_a_covariance_grown_by_their_age() -> None:
    for age in (0.0, 3_600.0):
        prior, problems = start_from(stored(known()), LAYOUT, CHANGED, THEN + age)
        assert not problems
        assert np.array_equal(prior.values, known().values)
        assert np.allclose(np.diag(prior.covariance), variances_after(age), rtol=1e-12)
        at = PARTS[SOURCES]
        off = prior.covariance[np.ix_(at, at)] - (known().covariance + air_covariance(age))[np.ix_(at, at)]
        assert np.allclose(off, np.diag(np.diag(off)), atol=1e-20), "dipole and sunlit part stay correlated"


def test_a_clock_that_was_set_back_counts_as_a_day() -> None:
    prior, problems = start_from(stored(known()), LAYOUT, CHANGED, THEN - 5.0)
    assert not problems
    assert np.allclose(np.diag(prior.covariance), variances_after(UNKNOWN_AGE), rtol=1e-12)


def test_stored_states_without_a_time_or_with_implausible_values_are_not_used() -> None:
    nothing = SlowStates(np.zeros(len(START)), PRIOR)
    timeless = {name: one for name, one in stored(known()).items() if name != LEARNED_AT}
    wild = stored(SlowStates(5.0 * START, known().covariance))
    for learned, refused in (({}, 0), (timeless, 0), (wild, len(PARTS))):
        prior, problems = start_from(learned, LAYOUT, CHANGED, THEN)
        assert len(problems) == refused
        assert np.array_equal(prior.values, nothing.values)
        assert np.array_equal(prior.covariance, nothing.covariance)
    part = {**stored(known()), ERRORS: wild[ERRORS]}
    prior, problems = start_from(part, LAYOUT, CHANGED, THEN)
    assert len(problems) == 1
    assert "sigma of the prior" in problems[0]
    assert np.array_equal(prior.values[PARTS[SOURCES]], known().values[PARTS[SOURCES]])


def test_the_first_boot_starts_from_the_described_residual_dipole() -> None:
    described = (2e-3, -1e-3, 5e-4)
    at = slice(DIPOLE.start - GYRO.start, DIPOLE.stop - GYRO.start)
    prior, problems = start_from({}, LAYOUT, CHANGED, THEN, described)
    assert not problems
    np.testing.assert_array_equal(prior.values[at], described)
    assert np.count_nonzero(prior.values) == 3
    np.testing.assert_array_equal(prior.covariance, PRIOR)
    near = known()
    near.values[at] = np.array(described) + 3.0 * START[at]
    prior, problems = start_from(stored(near), LAYOUT, CHANGED, THEN, described)
    assert not problems, "plausible near the description"
    np.testing.assert_array_equal(prior.values, near.values)


def test_the_filter_starts_from_stored_states_and_a_contradiction_resets_their_variances() -> None:
    prior, _ = start_from(stored(known()), LAYOUT, CHANGED, THEN)
    found = FreeFilter(INERTIA, SETTINGS, prior)
    gyro = np.array([1e-3, 2e-3, 3e-3])
    still, sure = np.array([0.0, 0.0, 0.0, 1.0]), 1e-8 * np.eye(3)
    found.start(still, sure, gyro)
    assert np.allclose(found.gyro_bias, 0.5e-3)
    assert np.allclose(found.rate, gyro - 0.5e-3, rtol=0.01), "by the gyro's matrix too"
    assert np.allclose(found.covariance[SLOW, SLOW], prior.covariance)
    found.start(still, sure, gyro, doubted=True)
    assert np.allclose(found.covariance[SLOW, SLOW], PRIOR)
    assert np.allclose(found.gyro_bias, 0.5e-3), "as a guess it stays"


def test_states_of_another_version_with_another_number_of_values_are_rejected() -> None:
    learned = stored(known())
    shorter = Learned.of(np.zeros(9), np.eye(9))
    prior, problems = start_from({**learned, ERRORS: shorter}, LAYOUT, CHANGED, THEN)
    assert problems == [f"{ERRORS} has 9 values instead of 27"]
    assert np.array_equal(prior.values[PARTS[ERRORS]], np.zeros(27))


def test_the_inertia_of_the_next_boot_may_have_changed_without_losing_its_correlations() -> None:
    prior, _ = start_from(stored(known()), LAYOUT, 1.0, THEN)
    at = PARTS[BODY]
    grown = prior.covariance[np.ix_(at, at)] - known().covariance[np.ix_(at, at)]
    np.testing.assert_allclose(grown, PRIOR[np.ix_(at, at)], rtol=1e-9, atol=1e-15)


def test_learned_values_that_the_motion_contradicts_are_reported_once() -> None:
    reported: list[tuple[events.EventKind, str]] = []
    log = SimpleNamespace(report=lambda kind, _, text: reported.append((kind, text)))
    found = SimpleNamespace(knowledge=Knowledge.LOST, contradictions=[])
    parts = (
        SimpleNamespace(detumbler=None),
        found,
        None,
        SimpleNamespace(events=log, facts=None, recorder=None),
    )
    view = OrbitView(*cast(Any, parts))
    output = SimpleNamespace(cycle=SimpleNamespace(start_ns=5, slot=1), estimate=None, mode=Mode.POINT)
    for _ in range(3):
        view.record_cycle(cast(Any, output))
        found.contradictions[:] = ["the motion contradicts the estimated inertia"]
    assert reported == [(events.LEARNED_REFUSED, "the motion contradicts the estimated inertia")]
