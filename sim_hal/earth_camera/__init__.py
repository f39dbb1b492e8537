"""The image model of a wide-angle camera that views Earth and Sun from a low orbit.

    model = EarthCameraModel.fuga15d(seed=1)
    scene = EarthScene(position, attitude, sun_position(julian_date))
    frame = render(model, scene, generator)

`scene` has the positions of camera, Earth and Sun, the atmosphere, and the radiance along lines of sight.
`image` has the camera's parameters and adds optics, the Sun's disc and the detector. Radiance is in units of
that of a white matt surface with the Sun at the zenith; the radiance of the Sun's disc is 46,000.
"""

from sim_hal.earth_camera.image import EarthCameraModel, expected_radiance, render
from sim_hal.earth_camera.scene import Atmosphere, EarthScene, nadir

__all__ = ["Atmosphere", "EarthCameraModel", "EarthScene", "expected_radiance", "nadir", "render"]
