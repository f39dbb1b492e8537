"""Image model of a wide-angle camera that views Earth and Sun from a low orbit.

    model = EarthCameraModel.fuga15d(seed=1)
    scene = EarthScene(position, attitude, sun_position(julian_date))
    frame = render(model, scene, generator)

The module `scene` holds the positions of camera, Earth and Sun, the atmosphere, and the radiance along lines
of sight. The module `image` holds the camera's parameters and models the optics, the Sun's disc and the
detector. Radiance is stated relative to that of a white Lambertian surface with the Sun at the zenith, so the
radiance of the Sun's disc is 46,000.
"""

from sim_hal.earth_camera.image import EarthCameraModel, expected_radiance, render
from sim_hal.earth_camera.scene import Atmosphere, EarthScene, nadir

__all__ = ["Atmosphere", "EarthCameraModel", "EarthScene", "expected_radiance", "nadir", "render"]
