"""The geometry of the camera that a configuration describes."""

from __future__ import annotations

import math

from flight.gnc.camera.knowledge import CameraKnowledge
from flight.gnc.camera.lens import CameraModel, Lens
from flight.gnc.camera.pinhole import Pinhole
from flight.schema.devices import Camera


def camera_model(camera: Camera) -> CameraModel:
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
    return CameraKnowledge(accuracy.focal_length, centre, distortion, accuracy.line_time)
