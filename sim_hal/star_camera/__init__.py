"""The star camera's image model: chapter 2 of Sease 2013, corrected, along the true attitude.

    model = StarCameraModel(field_of_view=np.radians(20.0))
    stars = catalogue.load()
    frame = render(model, stars.directions_at(2030.5), stars.magnitude, times, quaternions, rng)

`times` and `quaternions` are the camera's attitude over the exposure, sampled as finely as it was simulated.
`model` holds the camera's numbers, `attitude_history` interpolates the attitude, `point_spread` says how a
point's light falls on the pixels, `exposure` gathers it along each source's path, `rolling_shutter` does so
when each row has its own time (`line_time`), `detector` makes counts.
"""

from sim_hal.star_camera.image import SourceTrack, expected_electrons, render
from sim_hal.star_camera.model import StarCameraModel, scatter_hot_pixels

__all__ = ["SourceTrack", "StarCameraModel", "expected_electrons", "render", "scatter_hot_pixels"]
