"""Frames of the simulated star camera, at rest or rotating, with the attitude at mid-exposure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.streaks.camera_motion import CameraMotion
from sim_hal.star_camera import StarCameraModel, render
from tests.support.streak_bound import rate_bound, star_information

EPOCH = 2026.5
NARROW = StarCameraModel(field_of_view=float(np.radians(12.0)))


@dataclass(frozen=True)
class SkyFrame:
    """A frame with its true attitude, rate and stars.

    Attributes:
        attitude: attitude (4,) at mid-exposure, from ICRS to camera axes.
        rate: rate (3,) in camera axes, rad/s.
        stars: positions (n, 2) at mid-exposure, px, brightest star first; `electrons` (n,) of each.
    """

    pixels: Image
    camera: StarCameraModel
    attitude: FloatArray
    rate: FloatArray
    exposure: float
    stars: FloatArray
    electrons: FloatArray

    def rate_bound(self, most: int = 30) -> float:
        """Return the Cramer-Rao bound (rad/s) of the rate's magnitude, from the `most` brightest stars."""
        camera = self.camera
        floor = camera.read_noise**2 + camera.dark_current * self.exposure + 1.0 / 12.0
        stars, light = self.stars[:most], self.electrons[:most]
        bound = rate_bound(camera.pinhole, stars, light, self.rate, self.exposure, camera.psf_sigma, floor)
        axis = self.rate / np.linalg.norm(self.rate)
        return float(np.sqrt(axis @ bound.covariance @ axis))

    def attitude_bound(self, most: int = 60) -> FloatArray:
        """Return the Cramer-Rao bound of the attitude covariance (3, 3) at mid-exposure, rad^2.

        The bound uses the `most` brightest stars with independent positions. The bound assumes a known shape
        of the point spread function, and a constant rate whose errors are not correlated with the attitude at
        mid-exposure.
        """
        camera = self.camera
        floor = camera.read_noise**2 + camera.dark_current * self.exposure + 1.0 / 12.0
        motion = CameraMotion.steady(self.rate * self.exposure)
        total = np.zeros((3, 3))
        for star, light in zip(self.stars[:most], self.electrons[:most], strict=True):
            # The parameters are rotation, point spread width, x, y, electrons and background.
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
    """Return the derivatives (2, 3), px/rad, of a star's pixel coordinates.

    The derivatives are with respect to rotations about the camera axes.
    """
    direction = camera.unit_vectors(star)
    step = 1e-5 * np.cross(np.eye(3), direction)
    return np.asarray((camera.project(direction - step) - camera.project(direction + step)).T / 2e-5)


def sky() -> SkyIndex:
    """Return the default sky index, whose epoch is the epoch of the frames."""
    return default_index()


def sky_frame(
    rng: np.random.Generator,
    streak_px: float,
    exposure: float,
    camera: StarCameraModel = NARROW,
    theta_deg: tuple[float, float] = (30.0, 90.0),
) -> SkyFrame:
    """Return a random field of the real sky, with streaks of about `streak_px` px at the boresight.

    The angle of the rotation axis from the boresight is drawn between the two values of `theta_deg`.
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
