"""The geometry of the camera that a configuration describes."""

from __future__ import annotations

import math

from flight.gnc.camera.lens import CameraModel, Lens
from flight.gnc.camera.pinhole import Pinhole
from flight.schema.sections import Camera


def camera_model(camera: Camera) -> CameraModel:
    """Return the calibrated camera where the configuration has a lens, else the pinhole of its field.

    Raises LensError for a lens that cannot be.
    """
    if camera.lens is None:
        return Pinhole.from_field_of_view(camera.columns, camera.rows, math.radians(camera.field_of_view_deg))
    lens = camera.lens
    return Lens(camera.columns, camera.rows, lens.focal_length, lens.centre, lens.k1, lens.k2)
