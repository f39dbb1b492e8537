"""Find nadir from the Earth's limb, and the Sun, in images of a wide-angle camera.

The script draws both images: the Earth from 500 km, and the saturated disc of Sun and glare on a dark sky.
"""

from __future__ import annotations

import numpy as np

from knightcube import HorizonKnowledge, Pinhole, find_nadir, find_sun

EARTH_RADIUS, AIR, ALTITUDE = 6.371e6, 15e3, 500e3

camera = Pinhole.from_field_of_view(columns=512, rows=512, field_of_view=np.radians(67.0))
row, column = np.indices((512, 512))
rays = camera.unit_vectors(np.stack([column.ravel(), row.ravel()], axis=-1).astype(float))
noise = np.random.default_rng(1).normal(0.0, 1.0, (512, 512))

# The limb, which is the top of the sunlit air (height AIR), is 22 deg below the local horizontal. The
# boresight is 28 deg below the local horizontal, and the camera is rolled by 10 deg.
tilt, roll = np.radians([62.0, 10.0])
nadir = np.array([np.sin(tilt) * np.sin(roll), np.sin(tilt) * np.cos(roll), np.cos(tilt)])
limb = np.arcsin((EARTH_RADIUS + AIR) / (EARTH_RADIUS + ALTITUDE))
above = (np.arccos(rays @ nadir) - limb) * camera.focal_length  # px above the limb
# The optical depth of the air is 1 at the limb, and grows downwards by the factor e per 8 km (1.2 px).
earth = 150.0 * (1.0 - np.exp(-np.exp(-above / 1.2))).reshape(512, 512)

horizon = find_nadir(earth + 5.0 + noise, camera, HorizonKnowledge(altitude=ALTITUDE))
if horizon.nadir is None:
    raise SystemExit(f"no nadir: {horizon.reason}")
error = np.degrees(np.arccos(min(horizon.nadir.direction @ nadir, 1.0)))
print(f"nadir            {horizon.nadir.direction.round(4)}")
print(f"1 sigma          {np.degrees(horizon.nadir.sigma):.3f} deg; true error {error:.3f} deg")

towards_sun = camera.unit_vectors(np.array([[150.0, 320.0]]))[0]
from_sun = np.degrees(np.arccos(np.minimum(rays @ towards_sun, 1.0))).reshape(512, 512)
sun = find_sun(np.where(from_sun < 1.5, 250.0, 60.0 * np.exp(-from_sun)) + noise, camera)
if sun.sun is None:
    raise SystemExit(f"no Sun: {sun.reason}")
error = np.degrees(np.arccos(min(sun.sun.direction @ towards_sun, 1.0)))
print(f"Sun              {sun.sun.direction.round(4)}")
print(f"1 sigma          {np.degrees(sun.sun.sigma):.3f} deg; true error {error:.3f} deg")
