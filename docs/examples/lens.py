"""Calibrate a lens from images of the night sky, solve an image with it, and let a star tracker learn it.

The script draws the images of a camera whose lens has 2 % of barrel distortion at the corners.
"""

from __future__ import annotations

import sys

import numpy as np

from knightcube import Lens, StarTracker, calibrate_lens
from knightcube.astro import catalogue
from knightcube.astro.arrays import Image
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.lens import CameraKnowledge
from knightcube.vision.startracker.sky_map import Pointing
from knightcube.vision.startracker.solve import SolveSettings

TRUE_LENS = Lens(800, 600, focal_length=2250.0, centre=(404.0, 297.0), k1=-0.41, k2=0.0)
STARS = catalogue.load()


def draw(right_ascension: float, declination: float, roll: float) -> Image:
    """Return an image of the sky through the distorting lens; the three angles of the pointing are in deg."""
    matrix = attitude_matrix(Pointing(*np.radians([right_ascension, declination, roll])).quaternion())
    rays = STARS.directions_at(2026.5) @ matrix.T
    near = (rays[:, 2] > 0.97) & (STARS.magnitude < 7.5)
    image = np.full((TRUE_LENS.rows, TRUE_LENS.columns), 100.0)
    for (x, y), magnitude in zip(TRUE_LENS.project(rays[near]), STARS.magnitude[near], strict=True):
        column, row = round(x), round(y)
        if 8 <= column < TRUE_LENS.columns - 8 and 8 <= row < TRUE_LENS.rows - 8:
            dy, dx = np.mgrid[row - 7 : row + 8, column - 7 : column + 8] - np.array([y, x]).reshape(2, 1, 1)
            electrons = 1e5 * 10.0 ** (-0.4 * (magnitude - 4.0))
            spot = electrons / (2.0 * np.pi) * np.exp(-0.5 * (dx**2 + dy**2))
            image[row - 7 : row + 8, column - 7 : column + 8] += (
                1e5 * 10.0 ** (-0.4 * (magnitude - 4.0)) * spot
            )
    return np.random.default_rng(1).poisson(image).clip(0, 65_535).astype(np.uint16)


nights = [draw(15.0 * number, 8.0 * number - 20.0, 40.0 * number) for number in range(6)]
found = calibrate_lens(nights, fov_deg=20.0)
if found.lens is None or found.determined is None:
    sys.exit("\n".join(image.reason for image in found.images))
lens, sigma = found.lens, found.determined.calibration.sigma
print(f"focal length  {lens.focal_length:.2f} +- {sigma['focal_length']:.2f} px (true 2250)")
print(
    f"axis          {lens.centre[0]:.1f}, {lens.centre[1]:.1f} +- {sigma['centre_x']:.1f} px (true 404, 297)"
)
print(f"k1            {lens.k1:.4f} +- {sigma['k1']:.4f} (true -0.4100)")
print(f"omitted       {', '.join(found.determined.omitted) or 'nothing'}")

solution = StarTracker(camera=lens).solve(draw(84.0, -1.0, 0.0))
print(f"pointing      {solution.right_ascension_deg:.4f}, {solution.declination_deg:.4f} deg (true 84, -1)")

settings = SolveSettings(lens=CameraKnowledge(centre=5.0, distortion=0.02))
tracker = StarTracker(fov_deg=20.0, settings=settings, learn=True)
for number, night in enumerate(nights, start=1):
    tracker.solve(night)
    known = tracker.lens
    if known is not None and number in {1, 3, 6}:
        focal_length, x, y, _, _ = known.values[:5]
        print(
            f"learned {number}     {focal_length:.1f} +- {known.sigma[0]:.1f} px, "
            f"axis {x:.1f}, {y:.1f} +- {known.sigma[1]:.1f} px"
        )
