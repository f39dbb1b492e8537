"""The attitude at one time from the directions at that time: cameras' Sun and nadir, and the field.

TRIAD and QUEST (Meller et al., section 2) use one sigma per direction; `optimum` uses whole covariances and
reaches the bound that they set. A single direction, the magnetometer's, fixes two of three axes (the paper
assumes all): `with_direction` combines it with the cameras' attitude by information, `combined` combines two
complete attitudes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import SOLVERS
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix
from knightcube.astro.directions import tangent_basis
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.gnc.estimation.turn import skew

_MOST_TURNS = 20
_SETTLED = 1e-9
"""rad: the limit of the last turn; convergence is nearly quadratic."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """One direction: `observed` (3,) body and `reference` (3,) inertial axes, unit vectors.

    `covariance` (3, 3) rad^2 is of `observed`, body axes; its part along the direction has no effect.
    """

    observed: FloatArray
    reference: FloatArray
    covariance: FloatArray

    @property
    def sigma(self) -> float:
        """The mean sigma per axis across the direction, rad."""
        along = float(self.observed @ self.covariance @ self.observed)
        return float(np.sqrt(0.5 * (np.trace(self.covariance) - along)))


def camera_sight(
    to_camera: FloatArray,
    direction: FloatArray,
    covariance: FloatArray,
    reference: FloatArray,
    reference_sigma: float = 0.0,
) -> Sight:
    """Return the sight of a camera's measurement: `direction` (3,), `covariance` (3, 3) rad^2, camera axes.

    `to_camera` (3, 3) maps body vectors to those axes. `reference_sigma` rad per axis is the error of
    `reference` (3,), such as of nadir for an uncertain position, or of the mounting.
    """
    spread = to_camera.T @ covariance @ to_camera + reference_sigma**2 * np.eye(3)
    return Sight(to_camera.T @ direction, reference, spread)


def field_sight(
    field: FloatArray, reference: FloatArray, covariance: FloatArray, longest_angle: float = 1.0
) -> Sight:
    """Return the sight of a field: `field` (3,) T body, `reference` (3,) T, covariance (3, 3) T^2.

    The covariance must include the error of the magnetometer's bias. Raises AttitudeError where the
    field is so weak that its direction is off by more than `longest_angle` rad.
    """
    strength = float(np.linalg.norm(reference))
    if not float(np.sqrt(np.trace(covariance))) < longest_angle * strength:
        raise AttitudeError(f"a field of {strength:.2e} T gives no direction within its errors")
    return Sight(field / np.linalg.norm(field), reference / strength, np.asarray(covariance / strength**2))


def attitude(sights: Sequence[Sight], solver: Literal["triad", "quest"] = "quest") -> AttitudeFix:
    """Return TRIAD's or QUEST's attitude, each direction's errors assumed equal across it.

    Raises AttitudeError when the directions fix no attitude.
    """
    return SOLVERS[solver](
        np.array([sight.observed for sight in sights]),
        np.array([sight.reference for sight in sights]),
        np.array([sight.sigma for sight in sights]),
    )


def optimum(sights: Sequence[Sight]) -> AttitudeFix:
    """Return the attitude of least squares under the directions' whole covariances.

    Twice its loss is a chi-square of 2 n - 3 degrees of freedom. Raises AttitudeError like `attitude`.
    """
    quaternion = attitude(sights).quaternion
    for _ in range(_MOST_TURNS):
        information, moment, _ = _normal_equations(quaternion, sights)
        turn = np.asarray(np.linalg.solve(information, moment), dtype=float)
        quaternion = normalise(multiply(from_rotation_vector(turn), quaternion))
        if float(turn @ turn) < _SETTLED**2:
            break
    information, _, loss = _normal_equations(quaternion, sights)
    return AttitudeFix(quaternion, np.asarray(np.linalg.inv(information), dtype=float), loss)


def with_direction(fix: AttitudeFix, sight: Sight) -> AttitudeFix:
    """Return the optimal combination of an attitude and one more direction."""
    quaternion = fix.quaternion
    prior = np.linalg.inv(fix.covariance)
    for _ in range(_MOST_TURNS):
        information, moment, loss = _normal_equations(quaternion, [sight])
        off = to_rotation_vector(multiply(fix.quaternion, conjugate(quaternion)))
        turn = np.asarray(np.linalg.solve(prior + information, moment + prior @ off), dtype=float)
        quaternion = normalise(multiply(from_rotation_vector(turn), quaternion))
        if float(turn @ turn) < _SETTLED**2:
            break
    covariance = np.asarray(np.linalg.inv(prior + information), dtype=float)
    return AttitudeFix(quaternion, covariance, fix.loss + loss + 0.5 * float(off @ prior @ off))


def combined(first: AttitudeFix, second: AttitudeFix) -> AttitudeFix:
    """Return the optimal combination of two attitudes with independent errors.

    The added loss is half a chi-square of three degrees of freedom and measures their agreement.
    """
    apart = to_rotation_vector(multiply(second.quaternion, conjugate(first.quaternion)))
    both = np.linalg.inv(first.covariance + second.covariance)
    share = first.covariance @ both
    quaternion = normalise(multiply(from_rotation_vector(share @ apart), first.quaternion))
    covariance = share @ second.covariance
    loss = first.loss + second.loss + 0.5 * float(apart @ both @ apart)
    return AttitudeFix(quaternion, 0.5 * (covariance + covariance.T), loss)


def _normal_equations(
    quaternion: FloatArray, sights: Sequence[Sight]
) -> tuple[FloatArray, FloatArray, float]:
    """Return the information (3, 3) of small turns, their moment (3,) and half the sum of squares."""
    information, moment, loss = np.zeros((3, 3)), np.zeros(3), 0.0
    turn = attitude_matrix(quaternion)
    for sight in sights:
        expected = turn @ sight.reference
        x, y, z = expected.tolist()
        across = tangent_basis((x, y, z))
        weight = np.linalg.inv(across @ sight.covariance @ across.T)
        # After a further small turn e of the body the direction is A r + [A r x] e.
        rows = across @ np.array(skew((x, y, z)))
        residual = across @ (sight.observed - expected)
        information += rows.T @ weight @ rows
        moment += rows.T @ weight @ residual
        loss += 0.5 * float(residual @ weight @ residual)
    return information, moment, loss
