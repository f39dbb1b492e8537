"""A picture of what was solved: rings about the stars, names of the bright, where the sky's axes run.

Constellation lines are left out: no table of them was found whose licence is clear.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ground.pictures.overlay import OBJECT, STREAK, UNUSED, Colour, draw_ring, outlined
from knightcube.astro.arrays import FloatArray
from knightcube.astro.catalogue import PROPER_NAMES
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import UsageError
from knightcube.vision.camera.images import EXTRA
from knightcube.vision.startracker.index.sky_index import SkyIndex
from knightcube.vision.startracker.sky_map import Pointing
from knightcube.vision.startracker.solve import FrameSolution

if TYPE_CHECKING:
    from PIL import ImageDraw

Picture = npt.NDArray[np.uint8]

_MATCHED: Colour = STREAK
_UNMATCHED: Colour = UNUSED
_EXPECTED: Colour = (0, 158, 115)
_NAME: Colour = (240, 228, 66)
_COMPASS: Colour = OBJECT
_MOST_NAMES = 25
_FAINTEST_LABEL = 8
_ARROW_PART = 0.06


def draw_solution(picture: Picture, solution: FrameSolution, sky: SkyIndex) -> Picture:
    """Return `picture` (rows, columns, 3) with the solution drawn upon it.

    Orange rings: points that are guide stars; blue: points that are none; green, wider: where guide stars as
    bright as those should be. Yellow: names, or HIP numbers of the brightest. Vermillion: north (long) and
    east (short). Raises UsageError without Pillow.
    """
    drawn = picture.copy()
    scale = max(1.0, max(picture.shape) / 1024.0)
    for point, star in zip(solution.points, solution.star, strict=False):
        draw_ring(drawn, point, 6.0 * scale, _MATCHED if star >= 0 else _UNMATCHED)
    if solution.fix is None:
        for point in solution.points[len(solution.star) :]:
            draw_ring(drawn, point, 6.0 * scale, _UNMATCHED)
        return outlined(picture, drawn)
    matrix = attitude_matrix(solution.fix.quaternion)
    faintest = float(sky.stars.magnitude[solution.star[solution.matched]].max())
    bright = sky.stars.brighter_than(faintest)
    places = solution.camera.project(bright.direction @ matrix.T)
    if solution.mirrored:
        places[:, 0] = 2.0 * solution.camera.centre[0] - places[:, 0]
    inside = np.flatnonzero(solution.camera.contains(places))
    for place in places[inside]:
        draw_ring(drawn, place, 9.0 * scale, _EXPECTED)
    labels = [
        (places[star], PROPER_NAMES.get(int(bright.hip[star]), f"HIP {bright.hip[star]}"))
        for star in inside
        if int(bright.hip[star]) in PROPER_NAMES
    ]
    named = {text for _, text in labels}
    for star in inside[:_FAINTEST_LABEL]:
        text = PROPER_NAMES.get(int(bright.hip[star]), f"HIP {bright.hip[star]}")
        if text not in named:
            labels.append((places[star], text))
    return outlined(picture, _with_text(drawn, labels[:_MOST_NAMES], solution, scale))


def _with_text(
    picture: Picture, labels: list[tuple[FloatArray, str]], solution: FrameSolution, scale: float
) -> Picture:
    try:
        from PIL import Image as pillow  # noqa: PLC0415 - an extra, and only for pictures
        from PIL import ImageDraw as pillow_draw  # noqa: PLC0415
        from PIL import ImageFont  # noqa: PLC0415
    except ImportError as error:
        raise UsageError(f"names on a picture need Pillow: {EXTRA}") from error
    image = pillow.fromarray(picture)
    draw = pillow_draw.Draw(image)
    font = ImageFont.load_default(size=15.0 * scale)
    taken: list[tuple[float, float, float, float]] = []
    for (x, y), text in labels:
        # To the right of its star, else to the left; left out where both are taken by brighter stars' names.
        for place, anchor in (((x + 11.0 * scale, y), "lm"), ((x - 11.0 * scale, y), "rm")):
            box = draw.textbbox(place, text, font=font, anchor=anchor)
            if box[0] >= 0 and box[2] < picture.shape[1] and not any(_overlap(box, other) for other in taken):
                draw.text(place, text, fill=_NAME, font=font, anchor=anchor)
                taken.append(box)
                break
    if solution.fix is not None:
        _draw_compass(draw, picture.shape, solution, font, scale)
    return np.asarray(image)


def _overlap(box: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> bool:
    """Return whether two boxes of left, top, right, bottom share a pixel."""
    return box[0] <= other[2] and other[0] <= box[2] and box[1] <= other[3] and other[1] <= box[3]


def _draw_compass(
    draw: ImageDraw.ImageDraw, shape: tuple[int, ...], solution: FrameSolution, font: Any, scale: float
) -> None:
    """Draw north and east as seen at the boresight, in the picture's lower left corner."""
    size = _ARROW_PART * max(shape[:2])
    origin = np.array([1.6 * size, shape[0] - 1.6 * size])
    assert solution.fix is not None  # there is a compass to draw
    roll = Pointing.of(solution.fix.quaternion).roll
    # Up stands `roll` from north towards east, and east is to the left of north.
    north = np.array([np.sin(roll), -np.cos(roll)])
    east = np.array([north[1], -north[0]])
    if solution.mirrored:
        north, east = north * [-1.0, 1.0], east * [-1.0, 1.0]
    for direction, length, letter in ((north, size, "N"), (east, 0.6 * size, "E")):
        tip = origin + length * direction
        draw.line([tuple(origin), tuple(tip)], fill=_COMPASS, width=max(2, round(2.0 * scale)))
        draw.text(tuple(tip + 12.0 * scale * direction), letter, fill=_COMPASS, font=font, anchor="mm")
