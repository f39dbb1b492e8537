"""The camera that a configuration describes: its geometry, and how streaks in its frames are fitted."""

from __future__ import annotations

import math

from flight.schema.devices import Camera
from flight.schema.orbit_devices import WideCamera
from knightcube.vision.camera.lens import CameraKnowledge, CameraModel, Lens, Pinhole
from knightcube.vision.streaks.settings import LikelihoodSettings


def camera_model(camera: Camera | WideCamera) -> CameraModel:
    """Return the calibrated camera where the configuration has a lens, else the pinhole of its field.

    Raises LensError for a lens that cannot be.
    """
    if camera.lens is None:
        return Pinhole.from_field_of_view(camera.columns, camera.rows, math.radians(camera.field_of_view_deg))
    lens = camera.lens
    return Lens(camera.columns, camera.rows, lens.focal_length, lens.centre, lens.k1, lens.k2)


def camera_knowledge(camera: Camera) -> CameraKnowledge:
    """Return how well the pinhole is known that stands for the camera in the fit of streaks.

    The fit knows no lens: what a calibrated one differs by from that pinhole counts as unknown.
    """
    accuracy = camera.accuracy
    centre, distortion = accuracy.centre, accuracy.distortion
    if camera.lens is not None:
        lens = camera.lens
        middle = 0.5 * (camera.columns - 1), 0.5 * (camera.rows - 1)
        square = math.hypot(*middle) ** 2 / lens.focal_length**2
        centre = math.hypot(centre, math.dist(lens.centre, middle))
        distortion = math.hypot(distortion, square * (lens.k1 + square * lens.k2))
    line_time = accuracy.line_time
    if line_time is None and camera.line_time is not None:
        line_time = 0.0
    return CameraKnowledge(accuracy.focal_length, centre, distortion, line_time)


def likelihood_settings(camera: Camera) -> LikelihoodSettings:
    """Return the settings of the fit of streaks in the camera's frames."""
    return LikelihoodSettings(
        gain=camera.gain,
        saturation=camera.saturation,
        psf_sigma=camera.psf_sigma,
        line_time=camera.line_time,
        knowledge=camera_knowledge(camera),
    )
