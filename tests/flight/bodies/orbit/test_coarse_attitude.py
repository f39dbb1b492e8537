"""Tests that solar strings and magnetic field initialise the filter, and that a dead string is reported."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from flight.bodies.orbit.coarse_attitude import CoarseSunFeed
from flight.bodies.orbit.environment import EstimatedEnvironment
from flight.bodies.orbit.filter import OrbitFilter, OrbitFilterSettings
from hal.interfaces.devices import ImuReading, StringReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import Pressures
from knightcube.astro.quaternion import (
    angle_between,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.gnc.control.coil_map import CoilMap
from knightcube.gnc.estimation.estimate import ATTITUDE, AttitudeMeasurement, Knowledge
from knightcube.gnc.estimation.free_filter import FilterEnvironment
from knightcube.vision.solar_cells import SolarStringModel
from sim_hal.emulators.power import SolarCellsModel

FIELD = np.array([1e-5, 2e-5, 3e-5])
POSITION = np.array([4e6, -4e6, 3.9e6])
SUN = np.array([0.6, -0.48, 0.64])
SPIN = np.array([3e-3, -2e-3, 4e-3])
ROUND_NS = SECOND_NS // 2
MODEL = SolarCellsModel(np.concatenate([np.eye(3), -np.eye(3)]), np.full(6, 0.5), np.zeros(6))


class Lit:
    """A slowly rotating satellite at a fixed position, with its filter and its solar strings."""

    def __init__(self, seed: int, sunlit: float = 1.0) -> None:
        self._sunlit = sunlit
        self._generator = np.random.default_rng(seed)
        self.attitude = normalise(self._generator.standard_normal(4))
        settings = OrbitFilterSettings(
            inertia=1e-3 * np.eye(3),
            coils=CoilMap.equal(1.0, 0.1),
            gyro_noise=1e-4,
            field_noise=1e-7,
            unknown_psd=1e-8,
            settle_ns=0,
            history_ns=12 * SECOND_NS,
        )
        self.filter = OrbitFilter(settings, self.at)
        strings = SolarStringModel(peaks=np.full(6, 0.5))
        self.feed = CoarseSunFeed(strings, ROUND_NS, self.filter, cast(EstimatedEnvironment, self))
        self.wrong: list[str | None] = []
        self.magnet: FloatArray = np.zeros(3)
        self.begin_ns = 0  # time at which star fixes initialise the filter

    def at(self, _: int) -> FilterEnvironment:
        nothing = Pressures(np.zeros((1, 3)), np.zeros((1, 3)))
        return FilterEnvironment(FIELD, POSITION, nothing, self._sunlit)

    def sun(self, _: int) -> FloatArray:
        return SUN

    def fly(self, seconds: int, dead: int | None = None) -> None:
        step_ns = SECOND_NS // 10
        for time_ns in range(step_ns, seconds * SECOND_NS, step_ns):
            self.attitude = multiply(from_rotation_vector(0.1 * SPIN), self.attitude)
            body, noise = attitude_matrix(self.attitude), 1e-7 * self._generator.standard_normal(3)
            self.filter.command(time_ns, np.zeros(3))
            reading = (
                time_ns,
                time_ns,
                time_ns,
                self.attitude,
                SPIN,
                body @ FIELD + noise + self.magnet,
                np.zeros(3),
            )
            self.filter.accept(ImuReading(*reading))
            if time_ns == self.begin_ns:
                then_ns = time_ns - step_ns // 2
                self.filter.begin(AttitudeMeasurement(then_ns, self.attitude, 1e-4 * np.eye(3)))
            if time_ns % ROUND_NS == 0:
                currents = MODEL.currents(POSITION, 1.5e11 * SUN, body, self._generator)
                if dead is not None:
                    currents[np.argsort(-currents)[dead]] = 0.0
                self.wrong.append(self.feed.accept(StringReading(time_ns, currents)))


def test_sun_and_field_mostly_give_a_coarse_attitude_within_its_claims_and_without_a_star() -> None:
    flights = [Lit(seed) for seed in range(6)]
    for lit in flights:
        lit.fly(12)
        assert set(lit.wrong) == {"", None}
    known = [lit for lit in flights if lit.filter.knowledge is Knowledge.COARSE]
    assert len(known) >= 3
    for lit in known:
        found = lit.filter.at(lit.filter.measured_ns)
        sigma = np.sqrt(np.diag(found.covariance)[ATTITUDE])
        assert angle_between(found.quaternion, lit.attitude) < 3.0 * np.linalg.norm(sigma)


def test_a_star_attitude_that_contradicts_a_coarse_one_replaces_it_at_once() -> None:
    lit = Lit(1)
    lit.fly(12)
    then = lit.filter.measured_ns - SECOND_NS
    before = lit.filter.past(then)
    assert before is not None
    seen = multiply(from_rotation_vector(np.array([0.0, 0.8, 0.0])), before.quaternion)
    lit.filter.measure_late([AttitudeMeasurement(then, seen, 1e-9 * np.eye(3))], lambda _: None)
    assert lit.filter.restarts == 1
    assert lit.filter.knowledge is Knowledge.FINE


def test_a_filter_that_began_after_a_reading_of_the_strings_is_kept() -> None:
    """A reading of the solar strings from before a restart of the filter does not change the filter.

    Star fixes restart the filter at 15.4 s, and the reading of 15.25 s is checked afterwards.
    """
    lit = Lit(1)
    lit.begin_ns = 15_400_000_000
    lit.fly(16)
    assert lit.filter.restarts == 1
    found = lit.filter.at(lit.filter.measured_ns)
    assert np.sqrt(np.diag(found.covariance)[ATTITUDE]).max() < 0.02, "not that of the strings"


@pytest.mark.parametrize("rank", range(3))
def test_a_dead_string_misleads_no_estimate_beyond_its_claim(rank: int) -> None:
    flights = [Lit(seed) for seed in range(1000, 1006)]
    for lit in flights:
        lit.fly(12, dead=rank)
    known = [lit for lit in flights if lit.filter.knowledge is Knowledge.COARSE]
    assert len(known) >= 2
    for lit in known:
        found = lit.filter.at(lit.filter.measured_ns)
        off = to_rotation_vector(multiply(lit.attitude, conjugate(found.quaternion)))
        assert off @ np.linalg.solve(found.covariance[ATTITUDE, ATTITUDE], off) < 5.0**2
    if rank == 0:
        assert all(any(lit.wrong) for lit in flights)


def test_a_field_that_is_too_strong_starts_nothing_and_is_reported() -> None:
    lit = Lit(1)
    lit.magnet = np.array([0.0, 0.0, 2e-5])
    lit.fly(8)
    assert any(lit.wrong)
    assert not lit.filter.runs


def test_in_the_shadow_the_strings_are_neither_used_nor_reported_as_faulty() -> None:
    lit = Lit(3, sunlit=0.0)
    lit.fly(4)
    assert set(lit.wrong) == {None}
    assert not lit.filter.runs


def test_strings_that_repeat_their_currents_in_the_sunlight_are_reported() -> None:
    lit, stuck = Lit(1), np.array([0.3, 0.0, 0.2, 0.0, 0.25, 0.0])
    lit.fly(12)
    told = [lit.feed.accept(StringReading(k * SECOND_NS, stuck)) for k in range(12, 18)]
    assert told[-1] is not None
    assert "the same currents" in told[-1]
    dark = Lit(1, sunlit=0.0)
    assert [dark.feed.accept(StringReading(k * SECOND_NS, 0.0 * stuck)) for k in range(6)] == [None] * 6
