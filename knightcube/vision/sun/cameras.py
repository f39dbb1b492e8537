"""Orders cameras for reading: first the one with the coarse Sun in its field (Meller et al. 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.sun.strings import CoarseSun

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
