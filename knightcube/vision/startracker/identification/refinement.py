"""Least squares of attitude and scale over matched stars, from a start near the answer.

Wahba's problem with one unknown more: the factor k of all tangents x/z, y/z, by which the assumed focal
length is wrong. Gauss-Newton on the residuals e = b(k) - A r, which for a small turn d about the camera's
axes and a small change of ln k change by -[A r x] d + s dlnk, s = (x z^2, y z^2, -z (x^2 + y^2)). The least
sum of |e|^2 / sigma^2 is the maximum likelihood of directions with sigma rad along either axis across them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.wahba import AttitudeFix
from knightcube.astro.quaternion import from_matrix

# The rows of v @ _CROSS, reshaped to (3, 3), are the matrix [v x].
_CROSS = np.array(
    [[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0.0]]
)
# A step d leaves an error of about d^2: a hundredth of the arcsecond that a star tracker sees.
_SETTLED = 1e-4
_MOST_STEPS = 6
# Directions within about 1e-6 rad of one line leave the turn about it to rounding.
_LEAST_INFORMATION = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """Attitude and scale of the least squares.

    Attributes:
        matrix: (3, 3) A, ICRS to camera.
        scale: factor of the tangents.
        covariance: (4, 4) of the turn about the camera's axes, rad^2, and of ln scale; (3, 3) when the scale
            was held.
        squares: (n,) |e|^2 / sigma^2 of each star.
    """

    matrix: FloatArray
    scale: float
    covariance: FloatArray
    squares: FloatArray

    @property
    def scale_sigma(self) -> float:
        """Relative standard deviation of the scale; 0 when it was held."""
        return math.sqrt(self.covariance[3, 3]) if len(self.covariance) == 4 else 0.0

    def fix(self) -> AttitudeFix:
        """Return the attitude as the solvers of Wahba's problem do."""
        turn = np.ascontiguousarray(self.covariance[:3, :3])
        return AttitudeFix(from_matrix(self.matrix), turn, 0.5 * float(self.squares.sum()))

    def widened(self) -> Refinement:
        """Return the same with the covariance that the residuals themselves bear out."""
        factor = inflation(self.squares, len(self.covariance))
        return replace(self, covariance=self.covariance * factor)


def stretched(direction: FloatArray, scale: float | FloatArray) -> FloatArray:
    """Return unit vectors (n, 3) whose tangents x/z, y/z are `scale`, one or (n,), times `direction`'s."""
    if isinstance(scale, float) and scale == 1.0:
        return direction
    x, y, z = direction.T
    longer = np.empty_like(direction)
    longer[:, 0], longer[:, 1], longer[:, 2] = scale * x, scale * y, z
    longer /= np.sqrt(np.einsum("ij,ij->i", longer, longer))[:, None]
    return longer


def scale_slope(direction: FloatArray) -> FloatArray:
    """Return by how much directions (n, 3) move per unit of ln scale, across themselves."""
    squared = direction[:, 2:] * direction[:, 2:]
    slope = direction * squared
    slope[:, 2:] -= direction[:, 2:]
    return np.asarray(slope)


def inflation(squares: FloatArray, parameters: float) -> float:
    """Return by how much the residuals say that the variances are too small; 1 where that may be chance.

    `squares` (n,), each |e|^2 / sigma^2 of two components, together are a chi-square of 2n - `parameters`
    degrees of freedom, of which three of its sigmas are left to chance.
    """
    freedom = 2 * len(squares) - parameters
    if freedom <= 0:
        return 1.0
    excess = float(squares.sum()) / freedom
    return excess if excess > 1.0 + 3.0 * math.sqrt(2.0 / freedom) else 1.0


def refine(
    observed: FloatArray,
    reference: FloatArray,
    sigma: FloatArray,
    matrix: FloatArray,
    scale: float,
    free_scale: bool,
) -> Refinement | None:
    """Return attitude and scale that best turn `reference` into `observed` (n, 3), errors `sigma` (n,) rad.

    `observed` and `sigma` are those at scale 1; `matrix` (3, 3) and `scale` are the start. None where the
    stars do not determine the parameters, or the fit diverges.
    """
    parameters = 4 if free_scale else 3
    weight = (1.0 / (sigma * scale))[:, None]
    for _ in range(_MOST_STEPS):
        b = stretched(observed, scale)
        predicted = reference @ matrix.T
        residual = ((b - predicted) * weight).reshape(-1)
        slope = np.empty((len(b), 3, parameters))
        slope[:, :, :3] = -(predicted @ _CROSS).reshape(-1, 3, 3)
        if free_scale:
            slope[:, :, 3] = scale_slope(b)
        slope *= weight[:, :, None]
        flat = slope.reshape(-1, parameters)
        normal = flat.T @ flat
        try:
            covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        except np.linalg.LinAlgError:
            return None
        step = -(covariance @ (residual @ flat))
        longest = float(np.abs(step).max())
        if not _determined(normal, covariance) or not longest < 1.0:
            return None
        matrix = turned(matrix, step[:3])
        if free_scale:
            scale *= math.exp(float(step[3]))
        if longest < _SETTLED:
            break
    # The residuals after the last step, squared.
    left = (residual + flat @ step).reshape(-1, 3)
    return Refinement(matrix, scale, covariance, np.einsum("ij,ij->i", left, left))


def _determined(normal: FloatArray, covariance: FloatArray) -> bool:
    """Return whether every combination of parameters is determined beyond rounding.

    The largest element of a positive definite matrix is on its diagonal.
    """
    largest = float(normal.max()) * float(covariance.max())
    return 0.0 < largest * _LEAST_INFORMATION < 1.0


def turned(matrix: FloatArray, turn: FloatArray) -> FloatArray:
    """Return the attitude (3, 3) after a turn (3,) rad about the camera's own axes (Rodrigues)."""
    x, y, z = (float(component) for component in turn)
    angle = math.sqrt(x * x + y * y + z * z)
    first = math.sin(angle) / angle if angle > 0.0 else 1.0
    second = 2.0 * (math.sin(0.5 * angle) / angle) ** 2 if angle > 0.0 else 0.5
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(matrix - (first * cross - second * (cross @ cross)) @ matrix)
