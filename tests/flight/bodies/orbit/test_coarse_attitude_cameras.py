"""Tests that Sun and nadir from the horizon cameras initialise, update and correct the filter."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from flight.bodies.orbit.coarse_attitude import CONTRADICTED, HorizonCameraFeed
from flight.bodies.orbit.environment import EstimatedEnvironment
from flight.bodies.orbit.filter import OrbitFilter, OrbitFilterSettings
from hal.interfaces.devices import Frame, ImuReading
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
from knightcube.gnc.estimation.rigid_body import BodyErrors
from knightcube.vision.camera.lens import MountedCamera, Pinhole
from knightcube.vision.horizon_camera_job import HorizonCameraResult, MeasuredDirection, StructureMap, run

FIELD = np.array([1e-5, 2e-5, 3e-5])
POSITION = np.array([4e6, -4e6, 3.9e6])
DOWN = -POSITION / np.linalg.norm(POSITION)
SUN = np.array([0.6, -0.48, 0.64])
LENS = np.radians(0.02)
CAMERA = MountedCamera(Pinhole.from_field_of_view(64, 64, 1.0), np.array([0.0, 0.0, 0.0, 1.0]))


class Still:
    """A satellite at rest with a filter, a field measurement every 0.1 s, and horizon camera measurements."""

    def __init__(self, seed: int) -> None:
        self.attitude = normalise(np.random.default_rng(seed).standard_normal(4))
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
        around = cast(EstimatedEnvironment, self)
        bare = {0: StructureMap.of(np.zeros((64, 64), dtype=bool))}
        self.feed = HorizonCameraFeed([CAMERA], LENS, self.filter, around, None, None, bare)
        self.now_ns = 0
        self.sunlit = 1.0

    def at(self, _: int) -> FilterEnvironment:
        nothing = Pressures(np.zeros((1, 3)), np.zeros((1, 3)))
        return FilterEnvironment(FIELD, POSITION, nothing, self.sunlit)

    def sun(self, _: int) -> FloatArray:
        return SUN

    def rest(self, seconds: int) -> None:
        field = attitude_matrix(self.attitude) @ FIELD
        for _ in range(10 * seconds):
            self.now_ns += SECOND_NS // 10
            self.filter.command(self.now_ns, np.zeros(3))
            times = (self.now_ns, self.now_ns, self.now_ns)
            self.filter.accept(ImuReading(*times, self.attitude, np.zeros(3), field, np.zeros(3)))

    def seen(
        self, sigma: float, sun: bool = True, nadir: bool = True, turn: float = 0.0
    ) -> HorizonCameraResult:
        """Return the camera measurements of a body that is rotated by `turn` rad from its true attitude."""
        body = attitude_matrix(multiply(from_rotation_vector(np.array([turn, 0.0, 0.0])), self.attitude))

        def sighted(direction: FloatArray) -> MeasuredDirection:
            return MeasuredDirection(body @ direction, sigma**2 * np.eye(3), (0,))

        return HorizonCameraResult(sighted(SUN) if sun else None, sighted(DOWN) if nadir else None)

    def look(self, found: HorizonCameraResult) -> tuple[bool, bool]:
        return self.feed.accept(self.now_ns - SECOND_NS, found)

    @property
    def error(self) -> float:
        return float(angle_between(self.filter.at(self.now_ns).quaternion, self.attitude))


def test_sun_and_nadir_start_the_filter_and_one_direction_with_the_field_does() -> None:
    for sun, nadir in ((True, True), (True, False), (False, True)):
        craft = Still(1)
        craft.rest(3)
        assert craft.feed.needed
        assert craft.look(craft.seen(1e-3, sun, nadir)) == (sun, nadir)
        assert craft.filter.started
        assert craft.error < np.radians(3.0), "the field is known to a degree"


def test_the_first_attitude_counts_the_misalignments_of_the_cameras_of_sun_and_nadir() -> None:
    """Misaligned cameras do not contradict each other; the covariance is up to three times too large."""
    rng, sigma, squares = np.random.default_rng(11), 2e-4, []
    for seed in range(40):
        craft = Still(seed)
        craft.rest(2)
        body = attitude_matrix(craft.attitude)
        sights = []
        for reference in (SUN, DOWN):
            misalignment = rng.normal(0.0, BodyErrors().horizon / np.sqrt(3.0), 3) + rng.normal(0.0, sigma, 3)
            seen = attitude_matrix(from_rotation_vector(misalignment)) @ body @ reference
            sights.append(MeasuredDirection(seen, sigma**2 * np.eye(3), (0,)))
        assert craft.look(HorizonCameraResult(sights[0], sights[1])) == (True, True)
        estimate = craft.filter.at(craft.now_ns)
        error = to_rotation_vector(multiply(estimate.quaternion, conjugate(craft.attitude)))
        claim = estimate.covariance[ATTITUDE, ATTITUDE]
        squares.append(float(error @ np.linalg.solve(claim, error)) / 3.0)
    assert 0.3 < np.mean(squares) < 1.3


def test_a_nadir_with_a_sigma_of_eleven_degrees_starts_the_filter() -> None:
    craft = Still(2)
    craft.rest(3)
    assert craft.look(HorizonCameraResult(None, None)) == (False, False)
    assert craft.look(craft.seen(np.radians(11.0), sun=False)) == (False, True)
    assert craft.filter.runs


def test_repeated_directions_do_not_reduce_the_uncertainty_below_that_of_one() -> None:
    craft = Still(3)
    craft.rest(3)
    craft.look(craft.seen(1e-3))
    used = []
    for _ in range(60):
        craft.rest(2)
        used.append(craft.look(craft.seen(3e-3)))
    assert not all(sun for sun, _ in used[30:])
    assert craft.filter.worst_sigma > 0.4 * 3e-3, "sixty that count would make it a quarter"


def test_in_the_shadow_the_cameras_are_read_often_only_while_the_attitude_is_lost() -> None:
    for sunlit, often in ((1.0, True), (0.0, False)):
        craft = Still(7)
        craft.sunlit = sunlit
        craft.rest(3)
        assert craft.feed.needed
        craft.look(craft.seen(0.01))
        assert craft.filter.knowledge is Knowledge.COARSE
        assert craft.feed.needed is often


def test_one_false_horizon_is_refused_and_three_in_a_row_start_a_coarse_estimate_again() -> None:
    craft = Still(4)
    craft.rest(3)
    wrong = multiply(from_rotation_vector(np.array([0.2, 0.0, 0.0])), craft.attitude)
    craft.filter.begin(AttitudeMeasurement(craft.now_ns - SECOND_NS, wrong, 0.01**2 * np.eye(3)))
    assert craft.filter.knowledge is Knowledge.COARSE
    craft.rest(2)
    rounds = []
    for _ in range(CONTRADICTED + 2):
        craft.rest(1)
        rounds.append(craft.look(craft.seen(1e-3)))
    # The Sun direction does not contradict the estimate, because the error is a rotation about the Sun
    # direction.
    assert not any(nadir for _, nadir in rounds[:CONTRADICTED])
    assert rounds[-1] == (True, True)
    assert craft.error < 0.01
    assert craft.filter.restarts == 1


def test_the_sun_of_the_solar_strings_is_not_used_twice() -> None:
    craft = Still(5)
    craft.rest(3)
    craft.look(craft.seen(1e-2))
    craft.rest(1)
    found = craft.seen(1e-4, nadir=False)
    assert found.sun is not None
    strings = HorizonCameraResult(MeasuredDirection(found.sun.direction, found.sun.covariance, ()), None)
    assert craft.look(strings) == (False, False)
    assert craft.look(found) == (True, False)


def test_the_worker_gets_what_is_known_in_body_axes() -> None:
    craft = Still(6)
    craft.rest(3)
    frame = Frame(1, craft.now_ns - SECOND_NS, 0, craft.now_ns, np.zeros((64, 64), np.uint8))
    job = craft.feed.job({0: frame})
    assert job.knowledge.attitude is None
    body = attitude_matrix(craft.attitude)
    np.testing.assert_allclose(
        job.knowledge.sensed[0].camera, body @ FIELD / np.linalg.norm(FIELD), atol=1e-3
    )
    craft.look(craft.seen(1e-3))
    craft.rest(2)
    frame = Frame(2, craft.now_ns - SECOND_NS, 0, craft.now_ns, np.zeros((64, 64), np.uint8))
    rough = craft.feed.job({0: frame}).knowledge.attitude
    assert rough is not None
    assert angle_between(rough.quaternion, craft.attitude) < 0.01


def test_structure_learned_from_frames_is_known_to_the_next_job() -> None:
    """The worker's map of the image structure is part of the next job, even if the filter does not run."""
    craft = Still(3)
    bright = np.full((64, 64), 200, dtype=np.uint8)
    for sequence in range(2):
        frame = Frame(sequence, craft.now_ns, 0, craft.now_ns, bright)
        found = run(craft.feed.job({0: frame}))
        craft.look(found)
    assert craft.feed.job({0: frame}).structure[0].level == pytest.approx(200.0)
