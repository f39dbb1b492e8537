"""Tests of the basis of the tangent plane of a direction."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import tangent_basis
from knightcube.astro.quaternion import normalise


def test_with_the_direction_its_plane_makes_a_right_handed_frame() -> None:
    generator = np.random.default_rng(1)
    for direction in (*np.eye(3), *(normalise(generator.standard_normal(3)) for _ in range(20))):
        frame = np.vstack([tangent_basis(direction), direction])
        assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-15)
        assert np.linalg.det(frame) == pytest.approx(1.0)
