"""The image model of a wide-angle camera that views Earth and Sun from a low orbit.

    model = EarthCameraModel.fuga15d(seed=1)
    scene = EarthScene(position, attitude, sun_position(julian_date))
    frame = render(model, scene, generator)
    truth = limb_truth(scene, model)          # the true limb, and the Sun's elevation there

`model` holds the camera's parameters, `scene` the positions of camera, Earth and Sun, and the atmosphere.
`radiance` gives the radiance along lines of sight, the Sun's disc and its glare; `image` adds optics and
detector. `truth` gives the true nadir, Sun direction and limb. Radiance is in units of that of a white matt
surface with the Sun at the zenith; the radiance of the Sun's disc is 46,000.
"""

from sim_hal.earth_camera.image import expected_radiance, render
from sim_hal.earth_camera.model import EarthCameraModel
from sim_hal.earth_camera.scene import Atmosphere, EarthScene
from sim_hal.earth_camera.truth import LimbTruth, limb_truth, nadir, sun_direction, sun_point

APPARENT_LIMB_HEIGHT = Atmosphere().apparent_limb_height
"""Height (m) above the ellipsoid at which a sunlit limb has half its brightness (default atmosphere)."""

__all__ = [
    "APPARENT_LIMB_HEIGHT",
    "Atmosphere",
    "EarthCameraModel",
    "EarthScene",
    "LimbTruth",
    "expected_radiance",
    "limb_truth",
    "nadir",
    "render",
    "sun_direction",
    "sun_point",
]
