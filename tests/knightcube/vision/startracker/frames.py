"""Frames of the simulator's star camera, at rest or turning, with the attitude at mid-exposure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.index.sky_index import SkyIndex
from knightcube.vision.streaks.geometry import CameraMotion
from sim_hal.star_camera import StarCameraModel, render
from tests.support.streak_bound import rate_bound, star_information

EPOCH = 2026.5
NARROW = StarCameraModel(field_of_view=float(np.radians(12.0)))


@dataclass(frozen=True)
class SkyFrame:
    """A frame and its truth.

    Attributes:
        attitude: (4,) at mid-exposure, ICRS to camera.
        rate: (3,) rad/s in the camera's axes.
        stars: (n, 2) px at mid-exposure, the brightest first; `electrons` (n,) of each.
    """

    pixels: Image
    camera: StarCameraModel
    attitude: FloatArray
    rate: FloatArray
    exposure: float
    stars: FloatArray
    electrons: FloatArray

    def rate_bound(self, most: int = 30) -> float:
        """Return the Cramer-Rao bound of the rate's magnitude, rad/s, from the `most` brightest stars."""
        camera = self.camera
        floor = camera.read_noise**2 + camera.dark_current * self.exposure + 1.0 / 12.0
        stars, light = self.stars[:most], self.electrons[:most]
        bound = rate_bound(camera.pinhole, stars, light, self.rate, self.exposure, camera.psf_sigma, floor)
        axis = self.rate / np.linalg.norm(self.rate)
        return float(np.sqrt(axis @ bound.covariance @ axis))

    def attitude_bound(self, most: int = 60) -> FloatArray:
        """Return the Cramer-Rao bound of the attitude at mid-exposure, covariance (3, 3) rad^2.

        From the `most` brightest stars, whose places are independent: the shape of the point spread is known,
        and the turn over the exposure, odd in time, tells nothing of its middle while the rate is constant.
        """
        camera = self.camera
        floor = camera.read_noise**2 + camera.dark_current * self.exposure + 1.0 / 12.0
        motion = CameraMotion.steady(self.rate * self.exposure)
        total = np.zeros((3, 3))
        for star, light in zip(self.stars[:most], self.electrons[:most], strict=True):
            # After the turn and the point spread: x, y, electrons, background.
            alone = star_information(camera.pinhole, motion, star, float(light), camera.psf_sigma, floor)[
                4:, 4:
            ]
            if not alone.any():
                continue
            place = (
                alone[:2, :2] - alone[:2, 2:] @ np.linalg.pinv(alone[2:, 2:], hermitian=True) @ alone[2:, :2]
            )
            slope = _slope(camera.pinhole, star)
            total += slope.T @ place @ slope
        return np.asarray(np.linalg.inv(total), dtype=np.float64)


def _slope(camera: Pinhole, star: FloatArray) -> FloatArray:
    """Return d(pixel)/d(turn about the camera's axes), (2, 3) px/rad, by differences."""
    direction = camera.unit_vectors(star)
    step = 1e-5 * np.cross(np.eye(3), direction)
    return np.asarray((camera.project(direction - step) - camera.project(direction + step)).T / 2e-5)


def sky() -> SkyIndex:
    """Return the default index, of the frames' epoch."""
    return default_index()


def sky_frame(
    rng: np.random.Generator,
    streak_px: float,
    exposure: float,
    camera: StarCameraModel = NARROW,
    theta_deg: tuple[float, float] = (30.0, 90.0),
) -> SkyFrame:
    """Return a random field of the real sky with streaks of about `streak_px` at the boresight.

    The axis is as far off the boresight as `theta_deg` says, lowest to highest.
    """
    attitude = normalise(rng.standard_normal(4))
    theta, roll = rng.uniform(*np.radians(theta_deg)), rng.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.sin(theta) * np.cos(roll), np.sin(theta) * np.sin(roll), np.cos(theta)])
    turn = axis * streak_px / (camera.pinhole.focal_length * np.sin(theta))
    times = np.linspace(-0.5, 0.5, 3)
    attitudes = multiply(from_rotation_vector(times[:, None] * turn), attitude)
    stars = catalogue.load()
    pixels = render(
        camera, stars.directions_at(EPOCH), stars.magnitude, (times + 0.5) * exposure, attitudes, rng
    )
    places = camera.pinhole.project(stars.directions_at(EPOCH) @ attitude_matrix(attitude).T)
    inside = camera.pinhole.contains(places)
    electrons = camera.electrons(stars.magnitude[inside], exposure)
    return SkyFrame(pixels, camera, attitude, turn / exposure, exposure, places[inside], electrons)
