"""Errors of attitudes and rates as the thesis defines them (Sease 3.28, 3.29), and of star attitudes."""

from __future__ import annotations

import numpy as np

from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    angle_between,
    attitude_matrix,
    conjugate,
    multiply,
    to_rotation_vector,
)

MOST_STAR_MISMATCH = 4.0 * 25.9
"""Largest normalised squared error of a star attitude (three degrees of freedom).

25.9 is exceeded by chance once in 1e5 frames. The factor of four allows for streaks of 300 px.
"""


def field_fraction(rate: FloatArray, exposure: float, field_of_view: float) -> float:
    """Return the rotation during the exposure as a fraction of the field of view (3.28)."""
    return float(np.linalg.norm(rate)) * exposure / field_of_view


def error_in_pixels(angle: float, resolution: int, field_of_view: float) -> float:
    """Convert an angular error (rad) to px (3.29); `resolution` px span the field of view (rad)."""
    return angle * resolution / field_of_view


def attitude_error(estimate: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Return the total error and the error across the boresight (rad) of an attitude (4,).

    The total error is the rotation angle from truth to estimate. The error across the boresight is the angle
    between the true and the estimated boresight. It excludes the rotation about the boresight, which is about
    ten times less accurate in a narrow field.
    """
    difference = multiply(estimate, conjugate(truth))
    boresight = attitude_matrix(difference)[:, 2]
    across = np.arctan2(np.hypot(boresight[0], boresight[1]), boresight[2])
    return float(angle_between(estimate, truth)), float(across)


def star_errors(run: Run) -> tuple[FloatArray, FloatArray]:
    """Return the error (n, 3) of each star attitude against the truth, and its covariance (n, 3, 3)."""
    stars, truth = run["stars"], run["truth"]
    at = np.searchsorted(truth["time_ns"], stars["middle_ns"])
    # The truth is logged every 25 ms, and the middle of an exposure is one of these times.
    np.testing.assert_array_equal(truth["time_ns"][at], stars["middle_ns"])
    error = to_rotation_vector(multiply(stars["quaternion"], conjugate(truth["quaternion"][at])))
    xx, yy, zz, xy, xz, yz = stars["covariance"].T
    packed = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return error, np.moveaxis(packed, -1, 0)


def star_mismatch(run: Run) -> FloatArray:
    """Return the normalised squared error of each star attitude (three degrees of freedom)."""
    error, covariance = star_errors(run)
    return np.asarray(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error))


def assert_solved(run: Run) -> None:
    """Assert that each attitude comes from identified stars, and has an error within its covariance."""
    assert set(run["stars"]["status"].tolist()) == {b"solved"}
    assert star_mismatch(run).max() < MOST_STAR_MISMATCH
