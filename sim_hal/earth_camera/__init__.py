"""What a wide-angle camera sees of Earth and Sun from a low orbit, and what it makes of it.

    model = EarthCameraModel.fuga15d(seed=1)
    scene = EarthScene(position, attitude, sun.position(julian_date))
    frame = render(model, scene, generator)
    truth = limb_truth(scene, model)          # where the limb is, and how the Sun stands there

`scene` says where everything is, `atmosphere` and `albedo` what shines, `radiance` what a line of sight
meets, `sun_disc` the Sun and its glare, `optics` the blur, `detector` the counts, `truth` what to find.
Radiance is in units of that of a white matt surface with the Sun overhead, so the Sun's own disc is 46,000.
"""

from sim_hal.earth_camera.image import expected_radiance, render
from sim_hal.earth_camera.model import EarthCameraModel
from sim_hal.earth_camera.scene import Atmosphere, EarthScene
from sim_hal.earth_camera.truth import LimbTruth, limb_truth, nadir, sun_direction, sun_point

APPARENT_LIMB_HEIGHT = Atmosphere().apparent_limb_height
"""m above the ellipsoid where a sunlit limb has half its brightness, in the default atmosphere: 18.4 km."""

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
