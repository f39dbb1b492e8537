"""Estimate the body rate from one streaked image of the stars, and find an object that moves differently.

The script draws 60 stars in the image of a rotating camera, and one satellite among them.
"""

from __future__ import annotations

import sys

import numpy as np

from knightcube import Pinhole, detect_objects, estimate_rate
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector

EXPOSURE = 0.5  # s
RATE = np.array([0.03, 0.02, -0.05])  # rad/s, camera axes, with respect to the stars

camera = Pinhole.from_field_of_view(columns=512, rows=512, field_of_view=np.radians(20.0))
random = np.random.default_rng(3)
MARGIN = 8
frame = np.full((512 + 2 * MARGIN, 512 + 2 * MARGIN), 200.0)
row, column = np.indices(frame.shape) - MARGIN


def draw_path(points: FloatArray, electrons: float) -> None:
    """Draw the path (n, 2), px, of a point source of light into the frame, blurred by 1 px."""
    for x, y in points:
        if -3.0 < x < 514.0 and -3.0 < y < 514.0:
            left, top = int(x) - 5 + MARGIN, int(y) - 5 + MARGIN
            box = np.s_[top : top + 11, left : left + 11]
            spot = np.exp(-0.5 * ((column[box] - x) ** 2 + (row[box] - y) ** 2)) / (2.0 * np.pi)
            frame[box] += electrons / len(points) * spot


times = np.linspace(-0.5, 0.5, 200) * EXPOSURE
turns = [attitude_matrix(from_rotation_vector(RATE * time)) for time in times]
for electrons in np.geomspace(2e5, 5e3, 60):
    star = camera.unit_vectors(random.uniform(0.0, 511.0, (1, 2)))[0]
    draw_path(camera.project(np.array([turn @ star for turn in turns])), float(electrons))
draw_path(np.array([150.0, 330.0]) + np.outer(times, [60.0, -90.0]), 8e4)
image = random.poisson(frame[MARGIN:-MARGIN, MARGIN:-MARGIN]).clip(0, 65_535).astype(np.uint16)

found = estimate_rate(image, camera, EXPOSURE, prior_rate=0.8 * RATE, prior_sigma=0.005)
if found.rate is None or found.covariance is None:
    sys.exit(f"no rate: {found.reason}")
print(f"rate     {found.rate.round(5)} rad/s (true {RATE})")
print(f"1 sigma  {np.sqrt(np.diag(found.covariance)).round(5)} rad/s")
print(f"stars    {len(found.stars)} measured")

objects = detect_objects(image, camera, found.rate, EXPOSURE)
for item, direction in zip(objects.objects, objects.directions, strict=True):
    x, y = item.endpoints.mean(axis=0)
    print(f"object   at pixel {x:.1f}, {y:.1f}, direction {direction.round(4)} (true 150, 330)")
