"""The attitude by a solver of directions (Michalski 3.4), where the fit in the image is the default.

The image fit identifies the stars that disagree, and the lens; the solver then takes the directions of those
that agree, each with one error, its place's mean over both axes.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.wahba import AttitudeFix, Solver
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.startracker.identification.refinement import stretched
from knightcube.vision.startracker.image_fit import ImageFit
from knightcube.vision.startracker.lens_bend import bent


def attitude_by(
    solver: Solver,
    points: FloatArray,
    covariance: FloatArray,
    reference: FloatArray,
    camera: CameraModel,
    fit: ImageFit,
    late: FloatArray,
) -> AttitudeFix:
    """Return a solver's attitude from the stars at `points` (n, 2) px that agree in an image fit.

    `covariance` (n, 2, 2) px^2, `reference` (n, 3) and `late` (n, 2) are theirs, `camera` is that of the
    fit's start. Raises AttitudeError.
    """
    if len(late):
        points = points - fit.delay * late
    seen = bent(stretched(camera.unit_vectors(points), fit.scale), fit.bend)[fit.agree]
    pixels = np.sqrt(0.5 * np.trace(covariance[fit.agree], axis1=1, axis2=2))
    # A pixel off the boresight is seen shorter: by cos^2 along the radius and cos across it.
    sigma = pixels * fit.scale / camera.focal_length * seen[:, 2] ** 1.5
    return solver(seen, reference[fit.agree], sigma)
