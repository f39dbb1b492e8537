"""Tests of a vibration that all streaks of a frame have in common, on frames of an independent renderer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import from_rotation_vector, multiply, to_rotation_vector
from knightcube.vision.camera.lens import EXACT, Pinhole
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.geometry import CameraMotion, Vibration, paths
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult, StreakStatus
from tests.support.supersampled import Optics, Sky, light

_PINHOLE = Pinhole.from_field_of_view(560, 560, np.radians(7.0))
_EXPOSURE = 0.2
_TWO = Vibration(
    np.array([2.3, 7.0]),
    np.array([[1e-3, 2e-3, 0.0], [0.0, 1e-3, 1e-3]]),
    np.array([[0.0, 1e-3, -2e-3], [3e-3, 0.0, 0.0]]),
)


@dataclass(frozen=True)
class _Frame:
    """A frame with its true mean rate (3,), rad/s."""

    pixels: Image
    rate: FloatArray

    def motion(self, psf_sigma: float = 1.0) -> MotionResult:
        """Return the motion that the estimator finds in the frame."""
        settings = LikelihoodSettings(gain=1.0, line_time=0.0, psf_sigma=psf_sigma, knowledge=EXACT)
        return estimate_motion(self.pixels, _PINHOLE, _EXPOSURE, settings, self.rate)


def _frame(cycles: float, amplitude: float, seed: int) -> _Frame:
    """Return a frame of 14 stars with streaks of 80 px and a sinusoidal vibration of `amplitude` px."""
    rng = np.random.default_rng((seed, 11))
    focal = _PINHOLE.focal_length
    turn = np.array([0.6, -0.7, 1.5]) * 80.0 / focal
    way, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    shake = amplitude / focal * np.array([np.cos(way), np.sin(way), 0.0])

    def at(times: FloatArray) -> FloatArray:
        wave = np.sin(2.0 * np.pi * cycles * times + phase)
        return multiply(
            from_rotation_vector(wave[:, None] * shake), from_rotation_vector(times[:, None] * turn)
        )

    stars = _PINHOLE.unit_vectors(rng.uniform(60.0, 500.0, (14, 2)))
    sky = Sky(stars, rng.uniform(3e4, 2e5, len(stars)))
    electrons = rng.poisson(light(_PINHOLE, Optics(), sky, at, 200.0, 0.0, rng) + 100.0)
    begin, end = at(np.array([-0.5, 0.5]))
    rate = to_rotation_vector(multiply(end, np.array([-1.0, -1.0, -1.0, 1.0]) * begin)) / _EXPOSURE
    counts = electrons + rng.normal(0.0, 5.0, electrons.shape)
    return _Frame(np.clip(np.rint(counts), 0.0, 65_535.0).astype(np.uint16), np.asarray(rate))


def _sigmas(frame: _Frame, found: MotionResult) -> float:
    """Return the error of the rate in units of its standard deviations."""
    assert found.rate is not None
    assert found.covariance is not None
    error = found.rate - frame.rate
    return float(np.sqrt(error @ np.linalg.solve(found.covariance, error)))


def test_a_vibration_is_at_rest_at_mid_exposure_and_has_the_derivatives_of_its_rotation() -> None:
    time, step = np.linspace(-0.5, 0.5, 31), 1e-5
    assert np.abs(_TWO.rotation(np.zeros(1))).max() == 0.0
    for derivative in (0, 1):
        slope = (_TWO.rotation(time + step, derivative) - _TWO.rotation(time - step, derivative)) / (
            2.0 * step
        )
        assert _TWO.rotation(time, derivative + 1) == pytest.approx(slope, rel=1e-5, abs=1e-6)


def test_a_motion_with_a_vibration_has_an_exact_time_reversal() -> None:
    motion = CameraMotion(np.array([0.03, 0.02, 0.1]), np.zeros(3), vibration=_TWO)
    back = motion.directed(-motion.rotation)
    time = np.linspace(-0.5, 0.5, 21)
    stars = np.tile([[200.0, 90.0]], (len(time), 1))
    there, again = (paths(_PINHOLE, one, stars, t) for one, t in ((motion, time), (back, -time)))
    assert again.position == pytest.approx(there.position, abs=1e-9)
    assert again.velocity == pytest.approx(-there.velocity, abs=1e-6)


@pytest.mark.parametrize(("cycles", "amplitude"), [(1.6, 0.8), (4.3, 0.6)])
def test_a_resolved_vibration_leaves_no_error_in_the_rate(cycles: float, amplitude: float) -> None:
    """If the streaks resolve a vibration, it leaves no error in the rate.

    Without a vibration in its model, the estimator refuses the frame.
    """
    frame = _frame(cycles, amplitude, 0)
    found = frame.motion()
    assert found.status is StreakStatus.RATE
    assert found.rate is not None
    assert _sigmas(frame, found) < 4.0
    assert np.linalg.norm(found.rate - frame.rate) < 2e-3 * np.linalg.norm(frame.rate)


def test_a_vibration_that_no_streak_resolves_is_refused_or_within_the_claim() -> None:
    """A vibration that no streak resolves is refused, or the rate error is within its uncertainty.

    The streaks look like streaks with a slightly wider point spread, but their ends are displaced. A
    tolerance of 5 % of the point spread's variance would leave an error of 5.7 sigma in the rate of seed 5.
    """
    for seed in (2, 5, 6):
        frame = _frame(41.0, 0.45, seed)
        found = frame.motion()
        assert found.rate is None or _sigmas(frame, found) < 4.0
