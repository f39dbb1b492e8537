"""The rate from the attitudes at both ends of the exposure (Sease 3.22-3.29 corrected).

With the stars of the streaks identified, the first ends give the attitude at the start and the second ends
that at the end, each by ESOQ2; the turn between them over the exposure is the mean rate. The sign: a star
fixed in the sky moves with v' = -omega x v, so that Delta = A_end A_start^T = exp(-[omega T x]) and the axis
is that of Delta^T - Delta (3.24, 3.26 and 3.27 corrected). The angle comes from the quaternion, not from an
arc cosine of the trace (3.25), which loses half of all digits at small angles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.gnc.attitude import esoq2
from flight.gnc.attitude.wahba import AttitudeFix
from flight.gnc.camera.pinhole import Pinhole
from flight.gnc.errors import FlightError
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.directions import cross_matrices
from flight.gnc.math.quaternion import angle_between, attitude_matrix, conjugate, multiply, to_rotation_vector


@dataclass(frozen=True, slots=True)
class TwoAttitudes:
    """The attitudes at the two ends of one exposure and the mean rate between them.

    Attributes:
        start, end: of the camera, reference into camera.
        rotation_vector: (3,) rad, camera frame: principal axis times principal angle (3.25, 3.26).
        rate: (3,) rad/s, camera frame, of the camera with respect to the stars (3.27 with R_cam the
            identity).
        covariance: (3, 3) rad^2/s^2 of `rate`, the errors of the two ends being independent.
    """

    start: AttitudeFix
    end: AttitudeFix
    rotation_vector: FloatArray
    rate: FloatArray
    covariance: FloatArray

    @property
    def principal_angle(self) -> float:
        """The angle turned, rad (3.25)."""
        return float(np.linalg.norm(self.rotation_vector))

    @property
    def principal_axis(self) -> FloatArray:
        """The unit axis (3,) of the turn (3.26), NaN when there is none."""
        angle = self.principal_angle
        return self.rotation_vector / angle if angle > 0.0 else np.full(3, np.nan)


def solve(
    endpoints: FloatArray, reference: FloatArray, sigma: FloatArray, pinhole: Pinhole, exposure: float
) -> TwoAttitudes:
    """Return attitudes and rate from identified streaks.

    Args:
        endpoints: (n, 2, 2) px, streak, end, (x, y); all first ends simultaneous and earlier, without bias.
        reference: (n, 3) unit vectors of the streaks' stars, in the frame that the attitudes are wanted of.
        sigma: (n,) px, error of an endpoint.
        pinhole: the camera.
        exposure: s.

    Raises AttitudeError when the stars do not fix an attitude, FlightError for an impossible exposure.
    """
    if not (np.isfinite(exposure) and exposure > 0.0):
        raise FlightError(f"exposure of {exposure} s: must be finite and positive")
    vectors = pinhole.unit_vectors(endpoints)
    errors = sigma / pinhole.focal_length
    start = esoq2.solve(vectors[:, 0], reference, errors)
    end = esoq2.solve(vectors[:, 1], reference, errors)
    turn = multiply(end.quaternion, conjugate(start.quaternion))
    rotation = to_rotation_vector(turn)
    # The start's error is seen from the end's axes; both then turn the rotation vector.
    carried = attitude_matrix(turn)
    jacobian = _turn_to_vector(rotation)
    covariance = jacobian @ (end.covariance + carried @ start.covariance @ carried.T) @ jacobian.T
    return TwoAttitudes(start, end, rotation, rotation / exposure, covariance / exposure**2)


def field_fraction(rate: FloatArray, exposure: float, field_of_view: float) -> float:
    """Return the turn during the exposure as a part of the field of view, rad (3.28)."""
    return float(np.linalg.norm(rate)) * exposure / field_of_view


def error_in_pixels(angle: float, resolution: int, field_of_view: float) -> float:
    """Return an angular error in rad as px, for a camera of `resolution` px across its field, rad (3.29)."""
    return angle * resolution / field_of_view


def attitude_error(estimate: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Return the errors (whole, across) of an attitude (4,), rad.

    Whole is the angle of the turn from truth to estimate; across is the angle between the two boresights,
    free of the turn about the boresight, which a narrow field knows some ten times worse.
    """
    difference = multiply(estimate, conjugate(truth))
    boresight = attitude_matrix(difference)[:, 2]
    across = np.arctan2(np.hypot(boresight[0], boresight[1]), boresight[2])
    return float(angle_between(estimate, truth)), float(across)


def _turn_to_vector(rotation: FloatArray) -> FloatArray:
    """Return d(rotation vector)/d(small turn after it), (3, 3): the inverse right Jacobian of rotations."""
    angle = float(np.linalg.norm(rotation))
    cross = cross_matrices(rotation[None])[0]
    # Both terms of the second coefficient run to infinity at zero, where it is 1/12.
    second = 1.0 / 12.0 if angle < 1e-3 else 1.0 / angle**2 - 1.0 / (2.0 * angle * np.tan(0.5 * angle))
    return np.asarray(np.eye(3) + 0.5 * cross + second * cross @ cross)
