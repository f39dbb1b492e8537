"""Right ascension, declination and roll against known directions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.astro.quaternion import IDENTITY, angle_between, attitude_matrix
from knightcube.vision.startracker.sky_map import Pointing


def test_the_identity_looks_at_the_north_celestial_pole() -> None:
    assert Pointing.of(IDENTITY).declination == pytest.approx(0.5 * np.pi)


def test_north_is_up_at_no_roll_and_east_is_then_on_the_left() -> None:
    matrix = attitude_matrix(Pointing(0.0, 0.0, 0.0).quaternion())
    north, east = matrix @ [0.0, 0.0, 1.0], matrix @ [0.0, 1.0, 0.0]
    np.testing.assert_allclose(north, [0.0, -1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(east, [-1.0, 0.0, 0.0], atol=1e-15)


def test_a_quarter_of_roll_turns_the_image_until_up_is_east() -> None:
    matrix = attitude_matrix(Pointing(0.0, 0.0, 0.5 * np.pi).quaternion())
    np.testing.assert_allclose(matrix @ [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], atol=1e-15)


@given(st.floats(0.0, 6.28), st.floats(-1.57, 1.57), st.floats(0.0, 6.28))
def test_there_and_back_is_the_same_attitude(ra: float, dec: float, roll: float) -> None:
    q = Pointing(ra, dec, roll).quaternion()
    assert angle_between(Pointing.of(q).quaternion(), q) < 1e-9
