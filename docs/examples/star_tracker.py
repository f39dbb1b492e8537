"""Draw a field in Orion, and solve it with the star tracker of the library."""

from __future__ import annotations

import sys

import numpy as np

from knightcube import StarTracker
from knightcube.astro import catalogue
from knightcube.astro.arrays import Image
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.startracker.sky_map import Pointing

ARCSECOND = np.radians(1.0 / 3600.0)


def draw_orion(rows: int = 768, columns: int = 1024, fov_deg: float = 11.4) -> Image:
    """Return an image of the belt of Orion: catalogue stars, blurred by 1 px, with sky and noise."""
    camera = Pointing(*np.radians([84.05, -1.2, 0.0])).quaternion()
    stars = catalogue.load()
    x, y, z = attitude_matrix(camera) @ stars.directions_at(2026.5).T
    focal_length = 0.5 * columns / np.tan(np.radians(0.5 * fov_deg))
    image = np.full((rows, columns), 100.0)
    for k in np.flatnonzero((z > 0.98) & (stars.magnitude < 8.0)):
        px = focal_length * x[k] / z[k] + 0.5 * (columns - 1)
        py = focal_length * y[k] / z[k] + 0.5 * (rows - 1)
        if -4.0 < px < columns + 4.0 and -4.0 < py < rows + 4.0:
            flux = 2e4 * 10.0 ** (-0.4 * (stars.magnitude[k] - 5.0))
            across = np.exp(-0.5 * (np.arange(columns) - px) ** 2)
            down = np.exp(-0.5 * (np.arange(rows) - py) ** 2)
            image += flux / (2.0 * np.pi) * np.outer(down, across)
    return np.random.default_rng(1).poisson(image).clip(0, 65_535).astype(np.uint16)


solution = StarTracker(fov_deg=11.4).solve(draw_orion())
if not solution:
    sys.exit(f"not solved: {solution.reason}")
sigma = np.sqrt(np.diag(solution.covariance)) / ARCSECOND
print(f"right ascension  {solution.right_ascension_deg:.3f} deg")
print(f"declination      {solution.declination_deg:+.3f} deg")
print(f"roll             {solution.roll_deg:.3f} deg")
print(f"quaternion       {solution.quaternion.round(5)}")
print(f"1 sigma          {sigma[0]:.1f}, {sigma[1]:.1f} arcsec across, {sigma[2]:.1f} about the boresight")
print(f"field of view    {solution.field_of_view_deg:.3f} deg")
stars = solution.stars
for hip, magnitude, (x, y) in list(zip(stars.hip, stars.magnitude, stars.points, strict=True))[:3]:
    print(f"HIP {hip:<12d} V {magnitude:.2f} at pixel {x:.1f}, {y:.1f}")
