"""Tests of the distorted pinhole: positions in both directions, and the motion of stars in the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks import geometry
from knightcube.vision.streaks.geometry import CameraMotion, DistortedPinhole, paths, positions, sensitivities
from tests.support.compiled_forms import assert_forms_agree

_LENS = DistortedPinhole(1024, 1024, 2903.0, (3.0, -2.0), 0.002, 0.01)
_MOTION = CameraMotion(np.array([0.03, 0.05, 0.1]), np.array([0.003, -0.002, 0.01]))
_RNG = np.random.default_rng(1)
_STARS, _TIME = _RNG.uniform(50.0, 970.0, (20, 2)), _RNG.uniform(-0.5, 0.5, 20)


def test_distortion_moves_corner_and_centre_and_is_inverted() -> None:
    corner = np.array([[0.0, 0.0]])
    lens = DistortedPinhole(1024, 1024, 2903.0, (0.0, 0.0), 0.0, 0.01)
    assert lens.distorted(corner)[0] == pytest.approx([-5.115, -5.115])
    assert _LENS.distorted(np.array([_LENS.centre]))[0] == pytest.approx([514.5, 509.5])
    assert _LENS.undistorted(_LENS.distorted(_STARS)) == pytest.approx(_STARS, abs=1e-6)


def test_a_star_is_identified_by_its_distorted_pixel() -> None:
    assert positions(_LENS, _MOTION, _STARS, np.zeros(20)) == pytest.approx(_STARS, abs=1e-6)


def test_velocity_and_acceleration_are_derivatives_of_the_position() -> None:
    step = 1e-4
    drawn = paths(_LENS, _MOTION, _STARS, _TIME)
    before, after = (paths(_LENS, _MOTION, _STARS, _TIME + way * step) for way in (-1.0, 1.0))
    assert drawn.position == pytest.approx(positions(_LENS, _MOTION, _STARS, _TIME))
    velocity = (after.position - before.position) / (2.0 * step)
    acceleration = (after.velocity - before.velocity) / (2.0 * step)
    assert drawn.velocity == pytest.approx(velocity, abs=1e-3)
    assert drawn.acceleration == pytest.approx(acceleration, abs=1e-3)


@pytest.mark.parametrize("parameter", range(8))
def test_sensitivities_are_derivatives_of_the_position(parameter: int) -> None:
    """The sensitivities are the derivatives of a star's position.

    The derivative with respect to the acceleration has a second-order error of less than 0.1 %.
    """
    change = np.zeros(8)
    change[parameter] = 1e-5 if parameter < 6 else 1e-2

    def moved(way: float) -> FloatArray:
        by = way * change
        motion = replace(_MOTION, rate=_MOTION.rate + by[:3], acceleration=_MOTION.acceleration + by[3:6])
        return positions(_LENS, motion, _STARS + by[6:], _TIME)

    expected = (moved(1.0) - moved(-1.0)) / (2.0 * change[parameter])
    found = sensitivities(_LENS, _MOTION, _STARS, _TIME)[:, :, parameter]
    assert found == pytest.approx(expected, abs=1e-3 * float(np.abs(expected).max()))


@pytest.mark.parametrize("higher", [np.zeros((0, 3)), np.array([[0.02, -0.01, 0.03], [0.01, 0.05, -0.04]])])
@pytest.mark.parametrize("acceleration", [np.zeros(3), np.array([0.03, -0.2, 0.1])])
@pytest.mark.parametrize("rate", [np.zeros(3), np.array([0.03, 0.05, 0.1]), np.array([-0.4, 0.7, 0.5])])
def test_the_compiled_paths_equal_those_in_numpy(
    rate: FloatArray, acceleration: FloatArray, higher: FloatArray
) -> None:
    time = np.append(_TIME[1:], 0.0)
    arguments = (2903.0, 511.5, 411.5), (rate, acceleration, higher), _STARS, time
    assert_forms_agree(geometry._ideal_positions, *arguments)
    assert_forms_agree(geometry._ideal_paths, *arguments)
    for growing in (False, True):
        assert_forms_agree(geometry._ideal_sensitivities, *arguments, growing)
