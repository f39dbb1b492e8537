"""Job of the worker process `wide`: Sun and nadir in body axes from the images of the horizon cameras.

The currents of the solar strings (strings of solar cells) determine in which image the Sun is searched first.
If no camera finds the Sun, the Sun direction is computed from these currents. The nadir direction is fitted
to the limbs in all images at once. If no image shows a limb, the brightness of all images gives a coarse
nadir direction, because the Earth may fill one camera while the others are dark. The modules of the
estimators are imported at their first use, because the control process does not need them.

The spacecraft's own structure is masked in the images. The mask consists of configured structure (polygons
and an image file) and of structure estimated from successive frames. While the limb moves over the image, the
brightness of the scene changes repeatedly, whereas the brightness of the structure stays constant.
`StructureMap` compares the mean brightness of square blocks of pixels with that in the last counted frame. A
frame is counted if at least a quarter of its blocks have changed. A block whose brightness did not change in
`_QUIET_FRAMES` successive counted frames shows the spacecraft. If the brightness of an estimated block
changes, the block is at once removed from the mask, so that a wrong mask does not hide a limb.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.lens import MountedCamera
from knightcube.vision.horizon.settings import HorizonKnowledge, LogarithmicResponse, SensedDirection
from knightcube.vision.solar_cells import SolarStringModel

SUNLIT_COUNTS = 30.0
"""Threshold (counts) between pixels of the sunlit Earth and pixels with stray light from the Earth."""
LIT_SIGMA = 0.3
"""Largest standard deviation (rad) of an attitude that is used to predict the Sun direction."""
EARTHLIGHT_SIGMA = 0.1
"""Largest standard deviation (rad) of an attitude that predicts which solar strings the Earth illuminates."""
JUDGING_SIGMA = 0.005
"""Largest standard deviation (rad) of an attitude that is used to check the content of the images."""
_BLOCK = 8
"""Width and height of a block, px."""
_CHANGE = 0.08
"""Threshold for a change of a block's mean brightness, as a fraction of the brightness range of the image."""
_MOVED = 0.25
"""Minimum fraction of changed blocks for a frame to be counted."""
_QUIET_FRAMES = 12
"""Number of successive counted frames without change after which a block counts as spacecraft structure."""
_LARGEST = 0.4
"""Largest fraction of the image that an estimated mask may cover; a larger mask is discarded."""


def polygon_mask(rows: int, columns: int, polygons: Sequence[Sequence[tuple[float, float]]]) -> BoolArray:
    """Return the mask (rows, columns) of the pixels inside any polygon, by the even-odd rule.

    Each polygon is a sequence of corners (x, y), px, with (0, 0) at the centre of the top-left pixel.
    """
    mask = np.zeros((rows, columns), dtype=bool)
    if not polygons:
        return mask
    y, x = np.mgrid[0:rows, 0:columns].astype(float)
    for corners in polygons:
        inside = np.zeros_like(mask)
        for (x1, y1), (x2, y2) in zip(corners, (*corners[1:], corners[0]), strict=True):
            if y1 != y2:
                crosses = (y1 > y) != (y2 > y)
                inside ^= crosses & (x < x1 + (x2 - x1) * (y - y1) / (y2 - y1))
        mask |= inside
    return mask


@dataclass(frozen=True, slots=True, eq=False)
class StructureMap:
    """Blocks of one camera's images that show the spacecraft, as configured or as estimated from frames.

    Attributes:
        rows, columns: number of pixels of the images.
        configured: mask (m, n) of the blocks that contain spacecraft structure according to the
            configuration.
        level: mean brightness of the blocks in the last counted frame (m, n); an empty array before the first
            frame.
        quiet: number of counted frames since the last change of each block (m, n).
    """

    rows: int
    columns: int
    configured: BoolArray
    level: FloatArray
    quiet: IntArray

    @classmethod
    def of(cls, configured: BoolArray) -> StructureMap:
        """Return a map that contains only the structure in the mask `configured` (rows, columns)."""
        blocks = np.asarray(_blocks(configured.astype(float)) > 0.0)
        rows, columns = configured.shape
        return cls(rows, columns, blocks, np.zeros((0, 0)), np.zeros(blocks.shape, dtype=np.int64))

    def after(self, image: Image) -> StructureMap:
        """Return the map updated with a frame (rows, columns)."""
        level = _blocks(image)
        if not self.level.size:
            return replace(self, level=level)
        low, high = np.quantile(np.stack([level, self.level]), [0.02, 0.98])
        changed = np.abs(level - self.level) > _CHANGE * max(float(high - low), 1e-12)
        quiet = np.where(changed, 0, self.quiet)
        if np.count_nonzero(changed & ~self.configured) < _MOVED * changed.size:
            return replace(self, quiet=quiet)
        quiet = np.where(changed, 0, quiet + 1)
        if np.mean(quiet >= _QUIET_FRAMES) > _LARGEST:
            quiet = np.zeros_like(quiet)
        return replace(self, level=level, quiet=quiet)

    @property
    def mask(self) -> BoolArray | None:
        """The mask (rows, columns) of the pixels that show the spacecraft itself, or None if there are none.

        The estimated structure is widened by one block, because a block at the border of the structure shows
        partly the spacecraft and partly the scene. An unchanged block counts as structure only if at least
        two of its neighbours are also unchanged.
        """
        learned = self.quiet >= _QUIET_FRAMES
        learned &= _neighbours(learned) >= 2
        blocks = self.configured | (_neighbours(learned) > 0) | learned
        if not blocks.any():
            return None
        grown = np.repeat(np.repeat(blocks, _BLOCK, axis=0), _BLOCK, axis=1)
        return np.asarray(grown[: self.rows, : self.columns])


def _neighbours(blocks: BoolArray) -> IntArray:
    """Return how many of the eight neighbours of each block (m, n) are set."""
    padded = np.pad(blocks.astype(np.int64), 1)
    m, n = blocks.shape
    around = sum(padded[i : i + m, j : j + n] for i in range(3) for j in range(3))
    return np.asarray(around - blocks)


def _blocks(image: Image | FloatArray) -> FloatArray:
    """Return the mean of each block of an image (rows, columns); border pixels fill incomplete blocks."""
    rows, columns = image.shape
    padded = np.pad(image, ((0, -rows % _BLOCK), (0, -columns % _BLOCK)), mode="edge")
    m, n = padded.shape[0] // _BLOCK, padded.shape[1] // _BLOCK
    # Two sums are several times faster than a mean over two axes.
    lines = padded.reshape(m, _BLOCK, -1).sum(axis=1, dtype=float)
    return np.asarray(lines.reshape(m, n, _BLOCK).sum(axis=2) / _BLOCK**2)


@dataclass(frozen=True, slots=True, eq=False)
class HorizonCameraJob:
    """Images of all horizon cameras at one instant, and prior knowledge.

    Attributes:
        frames: images (rows, columns) by the index of their camera.
        cameras: all cameras.
        knowledge: prior knowledge, with directions and attitude in body axes.
        strings: model of the solar strings, and their currents (n,), A; None if the newest reading of the
            currents is too old.
        response: response of the cameras' detectors to light intensity, or None for linear detectors.
        structure: maps of the spacecraft's own structure in the images, by the index of the camera.
        earth_only: indices of the cameras in whose images the Sun is not searched.
    """

    frames: Mapping[int, Image]
    cameras: tuple[MountedCamera, ...]
    knowledge: HorizonKnowledge
    strings: tuple[SolarStringModel, FloatArray] | None
    response: LogarithmicResponse | None = None
    structure: Mapping[int, StructureMap] = field(default_factory=dict)
    earth_only: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredDirection:
    """A direction (3,) in body axes, its covariance (3, 3), rad^2, and the cameras that measured it.

    If `cameras` is empty, a Sun direction was estimated from the solar strings, and a nadir from the
    brightness of the images.
    """

    direction: FloatArray
    covariance: FloatArray
    cameras: tuple[int, ...]

    @property
    def mask(self) -> int:
        """Bit mask of the cameras; 0 without cameras."""
        return sum(1 << number for number in self.cameras)

    @property
    def sigma(self) -> float:
        """The standard deviation per axis, rad, computed from the mean variance over both axes."""
        return float(np.sqrt(0.5 * np.trace(self.covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class HorizonCameraResult:
    """The result of a job.

    Attributes:
        sun, nadir: measured directions of Sun and nadir in body axes, each None if it was not found.
        false: reasons why images contradict the known attitude, by the index of the camera; None if the
            attitude is not known accurately enough to check the images.
        structure: maps of the spacecraft's own structure, updated with these images, by camera index.
    """

    sun: MeasuredDirection | None
    nadir: MeasuredDirection | None
    false: Mapping[int, str] | None = None
    structure: Mapping[int, StructureMap] = field(default_factory=dict)


def run(job: HorizonCameraJob) -> HorizonCameraResult:
    """Return Sun and nadir. The worker process imports this function by its name."""
    structure = {n: each.after(job.frames[n]) for n, each in job.structure.items() if n in job.frames}
    job = replace(job, structure=structure)
    sun = _sun(job)
    knowledge = job.knowledge
    if sun is not None and knowledge.sun is not None:
        known = SensedDirection(sun.direction, knowledge.sun, sun.sigma)
        knowledge = replace(knowledge, sensed=(*knowledge.sensed, known))
    return HorizonCameraResult(sun, _nadir(job, knowledge, sun), _false_images(job), structure)


def _sun(job: HorizonCameraJob) -> MeasuredDirection | None:
    from knightcube.vision.solar_cells import CoarseSun, CoarseSunStatus, coarse_sun  # noqa: PLC0415
    from knightcube.vision.sun import LINEAR, SunSettings, sun_of_cameras  # noqa: PLC0415 - see the top

    coarse = CoarseSun(CoarseSunStatus.UNCERTAIN, reason="the solar strings deliver no readings")
    if job.strings is not None:
        coarse = coarse_sun(job.strings[1], job.strings[0], _expected_nadir(job.knowledge))
    frames = {number: image for number, image in job.frames.items() if number not in job.earth_only}
    found = sun_of_cameras(frames, job.cameras, coarse, LINEAR if job.response is None else SunSettings())
    if found.direction is None or found.covariance is None:
        return None
    return MeasuredDirection(
        found.direction, found.covariance, () if found.camera is None else (found.camera,)
    )


def _nadir(
    job: HorizonCameraJob, knowledge: HorizonKnowledge, sun: MeasuredDirection | None
) -> MeasuredDirection | None:
    from knightcube.vision.horizon.illumination import coarse_nadir, image_brightness  # noqa: PLC0415
    from knightcube.vision.horizon.limb import MEAN_RADIUS  # noqa: PLC0415 - see the top
    from knightcube.vision.horizon.nadir import HorizonStatus, nadir_of_cameras  # noqa: PLC0415
    from knightcube.vision.horizon.settings import EdgeSettings, HorizonSettings  # noqa: PLC0415

    settings = HorizonSettings(edges=EdgeSettings(response=job.response))
    masks = _masks(job)
    found = nadir_of_cameras(job.frames, job.cameras, knowledge, settings, masks)
    if found.nadir is not None:
        return MeasuredDirection(found.nadir.direction, found.nadir.covariance, found.cameras)
    if found.status is not HorizonStatus.NO_HORIZON or knowledge.position is None:
        return None
    looks = [
        image_brightness(image, job.cameras[n], SUNLIT_COUNTS, masks.get(n))
        for n, image in job.frames.items()
    ]
    altitude = float(np.linalg.norm(knowledge.position)) - MEAN_RADIUS
    sunward = _expected_sun(knowledge) if sun is None else sun.direction
    coarse = coarse_nadir(looks, altitude, sunward)
    return None if coarse is None else MeasuredDirection(coarse.direction, coarse.covariance, ())


def _false_images(job: HorizonCameraJob) -> dict[int, str] | None:
    """Return, by camera index, why images contradict the attitude, or None if images cannot be checked."""
    from knightcube.vision.horizon.illumination import image_brightness, why_false  # noqa: PLC0415
    from knightcube.vision.horizon.limb import MEAN_RADIUS  # noqa: PLC0415 - see the top

    rough, position = job.knowledge.attitude, job.knowledge.position
    nadir, sun = _expected_nadir(job.knowledge), _expected_sun(job.knowledge)
    if rough is None or rough.sigma > JUDGING_SIGMA or position is None or nadir is None or sun is None:
        return None
    altitude = float(np.linalg.norm(position)) - MEAN_RADIUS
    masks = _masks(job)
    looks = {
        n: image_brightness(image, job.cameras[n], SUNLIT_COUNTS, masks.get(n))
        for n, image in job.frames.items()
    }
    reasons = {n: why_false(look, nadir, altitude, sun) for n, look in looks.items()}
    return {n: reason for n, reason in reasons.items() if reason}


def _masks(job: HorizonCameraJob) -> dict[int, BoolArray]:
    """Return the masks (rows, columns) of the spacecraft's structure, by camera index."""
    return {n: mask for n, each in job.structure.items() if (mask := each.mask) is not None}


def _expected_nadir(knowledge: HorizonKnowledge) -> FloatArray | None:
    """Return the nadir direction (3,) in body axes from the attitude, or None if it is too uncertain."""
    rough, position = knowledge.attitude, knowledge.position
    if rough is None or rough.sigma > EARTHLIGHT_SIGMA or position is None:
        return None
    return np.asarray(attitude_matrix(rough.quaternion) @ (-position / np.linalg.norm(position)))


def _expected_sun(knowledge: HorizonKnowledge) -> FloatArray | None:
    """Return the Sun direction (3,) in body axes from the attitude, or None if it is too uncertain."""
    rough = knowledge.attitude
    if rough is None or rough.sigma > LIT_SIGMA or knowledge.sun is None:
        return None
    return np.asarray(attitude_matrix(rough.quaternion) @ (knowledge.sun / np.linalg.norm(knowledge.sun)))
