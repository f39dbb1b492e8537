"""Marks on a picture: where streaks and objects were found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation

from knightcube.astro.arrays import BoolArray, FloatArray

Colour = tuple[int, int, int]

STREAK: Colour = (230, 159, 0)
UNUSED: Colour = (86, 180, 233)
OBJECT: Colour = (213, 94, 0)
_RADIUS = 6.0
_OUTLINE = 1.5
"""px of darkness about each mark, in a picture of 1024: marks are read on a bright sky, too."""


def draw_marks(
    picture: npt.NDArray[np.uint8],
    endpoints: FloatArray,
    used: BoolArray,
    objects: Sequence[FloatArray],
) -> npt.NDArray[np.uint8]:
    """Return `picture` (rows, columns, 3) with marks.

    Streaks (n, 2, 2) px get a ring at each end, orange where they were used and blue where not; objects,
    (2, 2) px each, wider rings in vermillion.
    """
    drawn = picture.copy()
    for ends, is_used in zip(endpoints, used, strict=True):
        for end in ends:
            draw_ring(drawn, end, _RADIUS, STREAK if is_used else UNUSED)
    for ends in objects:
        for end in ends:
            draw_ring(drawn, end, 2.0 * _RADIUS, OBJECT)
            draw_ring(drawn, end, 2.0 * _RADIUS + 1.0, OBJECT)
    return outlined(picture, drawn)


def outlined(plain: npt.NDArray[np.uint8], drawn: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return a drawing upon `plain` (rows, columns, 3) with all that was drawn edged in black."""
    marks = np.any(plain != drawn, axis=2)
    width = max(1, round(_OUTLINE * max(plain.shape) / 1024.0))
    edged = drawn.copy()
    edged[binary_dilation(marks, np.ones((3, 3), dtype=bool), iterations=width) & ~marks] = 0
    return edged


def draw_ring(picture: npt.NDArray[np.uint8], centre: FloatArray, radius: float, colour: Colour) -> None:
    """Draw a ring of one pixel's width about `centre` (x, y); what lies off the picture is left out."""
    if not np.all(np.isfinite(centre)):
        return
    rows, columns = picture.shape[:2]
    angle = np.linspace(0.0, 2.0 * np.pi, max(16, round(8.0 * radius)), endpoint=False)
    x = np.rint(centre[0] + radius * np.cos(angle)).astype(int)
    y = np.rint(centre[1] + radius * np.sin(angle)).astype(int)
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    picture[y[inside], x[inside]] = colour
