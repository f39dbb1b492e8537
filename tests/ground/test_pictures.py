"""Tests that marks and names in plots have a black outline, so that they are legible on a bright sky."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.ndimage import binary_dilation

from ground.pictures import draw_marks, draw_solution
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.solve import SolveSettings
from tests.knightcube.vision.startracker.frames import NARROW, sky_frame

pytest.importorskip("PIL.Image", reason="needs the extra `images`")
Picture = npt.NDArray[np.uint8]


def _sky(size: int, grey: int) -> Picture:
    return np.full((size, size, 3), grey, dtype=np.uint8)


def _stand_apart(plain: Picture, drawn: Picture) -> bool:
    """Return whether no coloured pixel touches a pixel of the sky."""
    coloured = np.ptp(drawn.astype(int), axis=2) > 40
    around = binary_dilation(coloured, np.ones((3, 3), dtype=bool)) & ~coloured
    return bool(coloured.any() and np.all(np.any(drawn[around] != plain[around], axis=1)))


def test_marks_on_a_white_sky_have_an_outline_and_the_picture_is_not_changed() -> None:
    plain = _sky(200, 255)
    ends = np.array([[[20.0, 30.0], [60.0, 50.0]], [[100.0, 5.0], [195.0, 150.0]]])
    drawn = draw_marks(plain, ends, np.array([True, False]), [np.array([[150.0, 40.0], [160.0, 50.0]])])
    assert np.all(plain == 255)
    assert _stand_apart(plain, drawn)


def test_a_solved_picture_can_be_read_on_any_sky() -> None:
    frame = sky_frame(np.random.default_rng([41, 0]), 0.0, 0.5).pixels
    sky = default_index()
    found = solve_frame(frame, NARROW.pinhole, (0.98, 1.02), 1.0, sky, SolveSettings())
    for grey in (0, 128, 255):
        plain = _sky(len(frame), grey)
        drawn = draw_solution(plain, found, sky)
        yellow = np.all(np.abs(drawn.astype(int) - [240, 228, 66]) < 30, axis=2)
        assert yellow.sum() > 300, "names"
        assert grey == 0 or _stand_apart(plain, drawn)
