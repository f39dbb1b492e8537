"""Functions that draw results on pictures: streaks and objects, a plate solution, and the Earth's limb.

Constellation lines are not drawn, because no table with a clear licence was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.catalogue import PROPER_NAMES
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import UsageError
from knightcube.reference.horizon import ScannedHorizon
from knightcube.vision.camera.images import EXTRA
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.horizon.illumination import limb_rays
from knightcube.vision.horizon.nadir import HorizonSolution
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.sky_map import Pointing
from knightcube.vision.startracker.solve import FrameSolution

if TYPE_CHECKING:
    from PIL import ImageDraw

Colour = tuple[int, int, int]

STREAK: Colour = (230, 159, 0)
UNUSED: Colour = (86, 180, 233)
OBJECT: Colour = (213, 94, 0)
_RADIUS = 6.0
_OUTLINE = 1.5
"""Width (px in a picture of 1024 px) of the dark outline of the marks, for contrast on a bright sky."""


def draw_marks(
    picture: npt.NDArray[np.uint8], endpoints: FloatArray, used: BoolArray, objects: Sequence[FloatArray]
) -> npt.NDArray[np.uint8]:
    """Return `picture` (rows, columns, 3) with rings at the end points of streaks and objects.

    The rings of used streaks are orange, those of other streaks are blue, and those of objects are wider and
    vermilion. The end points of streaks are (n, 2, 2), px, and those of each object are (2, 2), px.
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
    """Return the picture `drawn` with black outlines around the marks, given the unmarked picture."""
    marks = np.any(plain != drawn, axis=2)
    width = max(1, round(_OUTLINE * max(plain.shape) / 1024.0))
    edged = drawn.copy()
    edged[binary_dilation(marks, np.ones((3, 3), dtype=bool), iterations=width) & ~marks] = 0
    return edged


def draw_ring(picture: npt.NDArray[np.uint8], centre: FloatArray, radius: float, colour: Colour) -> None:
    """Draw a ring one pixel wide around `centre` (x, y), clipped to the picture."""
    if not np.all(np.isfinite(centre)):
        return
    rows, columns = picture.shape[:2]
    angle = np.linspace(0.0, 2.0 * np.pi, max(16, round(8.0 * radius)), endpoint=False)
    x = np.rint(centre[0] + radius * np.cos(angle)).astype(int)
    y = np.rint(centre[1] + radius * np.sin(angle)).astype(int)
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    picture[y[inside], x[inside]] = colour


Picture = npt.NDArray[np.uint8]

_EXPECTED: Colour = (0, 158, 115)
_NAME: Colour = (240, 228, 66)
_MAX_NAMES = 25
_BRIGHTEST = 8  # number of brightest stars that are labelled even without a proper name
_ARROW = 0.06  # length of the compass's north arrow as a fraction of the picture size


def draw_solution(picture: Picture, solution: FrameSolution, sky: SkyIndex) -> Picture:
    """Return `picture` (rows, columns, 3) with the plate solution drawn on it.

    Points matched to guide stars have orange rings, and other points have blue rings. Wider green rings mark
    the expected positions of all guide stars that are as bright as the matched stars. Star names, or the HIP
    numbers of the brightest stars, are yellow. The vermillion compass has a long arrow to the north and a
    short arrow to the east. Raises UsageError if Pillow is not installed.
    """
    drawn = picture.copy()
    scale = max(1.0, max(picture.shape) / 1024.0)
    for point, star in zip(solution.points, solution.star, strict=False):
        draw_ring(drawn, point, 6.0 * scale, STREAK if star >= 0 else UNUSED)
    if solution.fix is None:
        for point in solution.points[len(solution.star) :]:
            draw_ring(drawn, point, 6.0 * scale, UNUSED)
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
    for star in inside[:_BRIGHTEST]:
        text = PROPER_NAMES.get(int(bright.hip[star]), f"HIP {bright.hip[star]}")
        if text not in named:
            labels.append((places[star], text))
    return outlined(picture, _with_text(drawn, labels[:_MAX_NAMES], solution, scale))


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
        # The label is on the right of the star, or on the left if the right is occupied, or else omitted.
        for place, anchor in (((x + 11.0 * scale, y), "lm"), ((x - 11.0 * scale, y), "rm")):
            box = draw.textbbox(place, text, font=font, anchor=anchor)
            free = all(
                box[2] < other[0] or other[2] < box[0] or box[3] < other[1] or other[3] < box[1]
                for other in taken
            )
            if box[0] >= 0 and box[2] < picture.shape[1] and free:
                draw.text(place, text, fill=_NAME, font=font, anchor=anchor)
                taken.append(box)
                break
    if solution.fix is not None:
        _draw_compass(draw, picture.shape, solution, font, scale)
    return np.asarray(image)


def _draw_compass(
    draw: ImageDraw.ImageDraw, shape: tuple[int, ...], solution: FrameSolution, font: Any, scale: float
) -> None:
    """Draw the directions of north and east at the boresight in the lower left corner."""
    size = _ARROW * max(shape[:2])
    origin = np.array([1.6 * size, shape[0] - 1.6 * size])
    assert solution.fix is not None
    roll = Pointing.of(solution.fix.quaternion).roll
    # The picture's upward direction has the position angle `roll`, from north to east. East is left of north.
    north = np.array([np.sin(roll), -np.cos(roll)])
    east = np.array([north[1], -north[0]])
    if solution.mirrored:
        north, east = north * [-1.0, 1.0], east * [-1.0, 1.0]
    for direction, length, letter in ((north, size, "N"), (east, 0.6 * size, "E")):
        tip = origin + length * direction
        draw.line([tuple(origin), tuple(tip)], fill=OBJECT, width=max(2, round(2.0 * scale)))
        draw.text(tuple(tip + 12.0 * scale * direction), letter, fill=OBJECT, font=font, anchor="mm")


_EDGE_RADIUS = 5.0
_DOT = 0.0  # radius (px) of a ring that is a single pixel


def draw_horizon(
    picture: npt.NDArray[np.uint8], solution: HorizonSolution, camera: CameraModel
) -> npt.NDArray[np.uint8]:
    """Return `picture` (rows, columns, 3) with the horizon drawn on it.

    The fitted limb is drawn as a line. Edge points on the limb have orange rings, and other edge points have
    blue rings.
    """
    drawn = picture.copy()
    if solution.view is not None:
        # The limb is rarely longer than four picture perimeters, so its points are at most 1 px apart.
        limb = camera.project(limb_rays(solution.view, 8 * (camera.columns + camera.rows)))
        for point in limb[camera.contains(limb)]:
            draw_ring(drawn, point, _DOT, STREAK)
    for point, used in zip(solution.points, solution.on_horizon, strict=True):
        draw_ring(drawn, point, _EDGE_RADIUS, STREAK if used else UNUSED)
    return outlined(picture, drawn)


def draw_circle(
    picture: npt.NDArray[np.uint8], seen: ScannedHorizon, camera: CameraModel
) -> npt.NDArray[np.uint8]:
    """Return `picture` (rows, columns, 3) with the circle fit of Meller et al. and its edge points."""
    drawn = picture.copy()
    angle = np.arange(8 * (camera.columns + camera.rows)) * (0.25 * np.pi / (camera.columns + camera.rows))
    ring = seen.circle.centre + seen.circle.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = camera.project(camera.ideal.unit_vectors(ring))
    for point in points[camera.contains(points)]:
        draw_ring(drawn, point, _DOT, STREAK)
    for point in seen.points:
        draw_ring(drawn, point, _EDGE_RADIUS, STREAK)
    return outlined(picture, drawn)
