"""The star camera's image model: chapter 2 of Sease 2013, corrected, along the true attitude.

    model = StarCameraModel(field_of_view=np.radians(20.0))
    stars = catalogue.load()
    frame = render(model, stars.directions_at(2030.5), stars.magnitude, times, quaternions, rng)

`times` and `quaternions` are the camera's attitude over the exposure, sampled at the steps of the simulation.
`image` has the camera's parameters, interpolates the attitude and makes the counts. `exposure` integrates the
light of each source along its path, with a global or a rolling shutter (`line_time`). `objects` adds moving
objects and the view from an orbit.
"""

from sim_hal.star_camera.image import (
    SourceTrack,
    StarCameraModel,
    expected_electrons,
    render,
    scatter_hot_pixels,
)

__all__ = ["SourceTrack", "StarCameraModel", "expected_electrons", "render", "scatter_hot_pixels"]
