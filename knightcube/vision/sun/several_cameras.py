"""The Sun from several cameras and the solar strings (Meller et al., chapter 2).

    found = sun_of_cameras(frames, cameras, coarse_sun(currents, strings), settings)

The strings say which camera to read first; where no camera finds the Sun, their own direction stands in, with
its own covariance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.lens import CameraModel, MountedCamera
from knightcube.vision.camera.pixel_access import ArrayPixels, PixelAccess
from knightcube.vision.sun.direction import SunMeasurement, SunSettings, SunSolution, find_sun
from knightcube.vision.sun.solar_cells import CoarseSun

_SIGMAS = 3.0
_RING = 12


@dataclass(frozen=True, slots=True)
class CameraChoice:
    """A camera and whether it may see the Sun.

    Attributes:
        index: of the camera.
        likely: whether the coarse Sun itself is in its field.
        possible: whether the Sun is within three standard deviations.
        angle: rad from its boresight to the coarse Sun.
    """

    index: int
    likely: bool
    possible: bool
    angle: float


def cameras_by_sun(
    sun: CoarseSun, cameras: Sequence[CameraModel], mountings: Sequence[FloatArray]
) -> list[CameraChoice]:
    """Return the cameras in the order in which they are to be read for the Sun; none when it is dark.

    `mountings` are quaternions (4,), body into camera. With a coarse Sun those that have it in their field
    come first, then those that may have; by the angle from the boresight in each. With uncertain
    strings all cameras are possible, in the given order. Raises ValueError for unlike numbers of both.
    """
    if len(cameras) != len(mountings):
        raise ValueError(f"{len(cameras)} cameras with {len(mountings)} mountings: give one for each")
    if sun.direction is None or sun.basis is None or sun.tangent_covariance is None:
        if sun.status is sun.status.DARK:
            return []
        return [CameraChoice(index, False, True, float("nan")) for index in range(len(cameras))]
    angle = np.arange(_RING) * (2.0 * np.pi / _RING)
    root = np.linalg.cholesky(sun.tangent_covariance)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ root.T @ sun.basis
    around = np.concatenate(
        [sun.direction[None, :], *(sun.direction + k * ring for k in (1.0, 2.0, _SIGMAS))]
    )
    choices = []
    for index, (camera, mounting) in enumerate(zip(cameras, mountings, strict=True)):
        seen = around @ quaternion.attitude_matrix(mounting).T
        inside = camera.contains(camera.project(seen))
        away = float(np.arccos(np.clip(seen[0, 2], -1.0, 1.0)))
        choices.append(CameraChoice(index, bool(inside[0]), bool(inside.any()), away))
    return sorted(choices, key=lambda choice: (not choice.likely, not choice.possible, choice.angle))


_CONTRADICTED = 5.0
"""Largest distance between a camera's Sun and the coarse Sun, in standard deviations of the coarse Sun."""

_CUT = np.radians(0.05)
"""Systematic error per axis (rad) of a disc that the frame's edge cuts."""


@dataclass(frozen=True, slots=True, eq=False)
class SunOfCameras:
    """The Sun in body axes, and where it is from.

    Attributes:
        direction: (3,) unit vector; None when neither a camera nor the strings have it.
        covariance: (3, 3) rad^2 of its error, nothing along it.
        camera: the number of the camera that found it; None where it is the strings'.
        each: what the cameras gave, in the order in which they were read.
        reason: why no camera has it; empty where one has.
    """

    direction: FloatArray | None
    covariance: FloatArray | None
    camera: int | None
    each: Mapping[int, SunSolution]
    reason: str = ""


def sun_of_cameras(
    frames: Mapping[int, Image | PixelAccess],
    cameras: Sequence[MountedCamera],
    strings: CoarseSun,
    settings: SunSettings,
) -> SunOfCameras:
    """Return the Sun that the first of some cameras' frames, by number, shows, or else the strings' own.

    A camera that cannot have the Sun in view by the strings is not read; a Sun that contradicts theirs is
    not taken.
    """
    order = cameras_by_sun(strings, [one.lens for one in cameras], [one.mounting for one in cameras])
    each: dict[int, SunSolution] = {}
    reason = "" if order else "no light: " + strings.reason
    for choice in order:
        frame = frames.get(choice.index)
        if frame is None or not choice.possible:
            continue
        camera = cameras[choice.index]
        access = ArrayPixels(frame) if isinstance(frame, np.ndarray) else frame
        solution = each[choice.index] = find_sun(access, camera.lens, settings)
        if solution.sun is None:
            reason = f"camera {choice.index}: {solution.reason}"
            continue
        direction = camera.in_body(solution.sun.direction)
        if not _contradicts(direction, strings):
            return SunOfCameras(direction, _in_body(solution.sun, camera), choice.index, each)
        reason = f"camera {choice.index}: a Sun where the strings have none"
    if strings.direction is None or strings.basis is None or strings.tangent_covariance is None:
        return SunOfCameras(None, None, None, each, reason or strings.reason)
    covariance = strings.basis.T @ strings.tangent_covariance @ strings.basis
    return SunOfCameras(
        strings.direction, covariance, None, each, reason or "no camera has the Sun in its field"
    )


def _in_body(sun: SunMeasurement, camera: MountedCamera) -> FloatArray:
    across = np.eye(3) - np.outer(sun.direction, sun.direction)
    covariance = sun.covariance + (_CUT**2 * across if sun.cut else 0.0)
    return np.asarray(camera.to_camera.T @ covariance @ camera.to_camera)


def _contradicts(direction: FloatArray, strings: CoarseSun) -> bool:
    """Return whether a direction lies farther off the strings' Sun than their errors explain."""
    if strings.direction is None or strings.basis is None or strings.tangent_covariance is None:
        return False
    if float(direction @ strings.direction) <= 0.0:
        return True
    off = strings.basis @ (direction / float(direction @ strings.direction))
    return float(off @ np.linalg.solve(strings.tangent_covariance, off)) > _CONTRADICTED**2
