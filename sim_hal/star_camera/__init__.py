"""Image model of the star camera for any motion during the exposure, after Sease 2013, chapter 2 (corrected).

    model = StarCameraModel(field_of_view=np.radians(20.0))
    stars = catalogue.load()
    frame = render(model, stars.directions_at(2030.5), stars.magnitude, times, quaternions, rng)

`times` and `quaternions` are the times and attitudes of the simulation steps during the exposure. The module
`image` renders the stars, and the module `objects` adds moving objects and the effects of the camera's orbit.
"""

from sim_hal.star_camera.image import (
    SourceTrack,
    StarCameraModel,
    expected_electrons,
    render,
    scatter_hot_pixels,
)

__all__ = ["SourceTrack", "StarCameraModel", "expected_electrons", "render", "scatter_hot_pixels"]
