"""Inertia tensors of rigid bodies: principal axes, physical validity, and the inertia tensor of a box."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray, brief, finite_array
from knightcube.errors import ArgumentError

_ROUNDING = 1e-6
"""Largest tolerated violation of symmetry and of the triangle inequality, as a fraction of the trace."""


def principal_axes(inertia: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the principal moments (3,), kg m^2, and the rotation (3, 3) from body axes to principal axes.

    The principal axes are numbered and directed so that the rotation angle is as small as possible. For a
    diagonal tensor, the rotation is the identity.
    """
    if not np.any(inertia - np.diag(np.diag(inertia))):
        return np.diag(inertia).copy(), np.eye(3)
    moments, axes = np.linalg.eigh(inertia)
    orders = list(permutations(range(3)))
    best = orders[int(np.argmax([np.abs(np.diag(axes[:, order])).sum() for order in orders]))]
    rotation = axes[:, best].T
    rotation = rotation * np.where(np.diag(rotation) < 0.0, -1.0, 1.0)[:, None]
    if np.linalg.det(rotation) < 0.0:
        rotation[int(np.argmin(np.diag(rotation)))] *= -1.0
    return moments[list(best)], rotation


def inertia_problem(inertia: FloatArray) -> str:
    """Return the reason why an inertia tensor (3, 3), kg m^2, is impossible, or "" for a valid tensor."""
    scale = float(np.abs(inertia).max())
    for row, column in ((0, 1), (0, 2), (1, 2)):
        above, below = float(inertia[row, column]), float(inertia[column, row])
        if abs(above - below) > _ROUNDING * scale:
            return (
                f"is not symmetric: row {row + 1}, column {column + 1} is {above:g}, and row {column + 1}, "
                f"column {row + 1} is {below:g}: give both the same value, the negative of the product "
                "of inertia"
            )
    moments = np.linalg.eigvalsh(0.5 * (inertia + inertia.T))
    shown = ", ".join(f"{moment:.6g}" for moment in moments)
    if moments[0] <= 0.0:
        return f"has the principal moments {shown}: all must be positive, check the products of inertia"
    if moments[2] > moments[0] + moments[1] + _ROUNDING * moments.sum():
        return (
            f"has the principal moments {shown}: the largest must not exceed the sum of the other two "
            f"({moments[0] + moments[1]:.6g}), check the moments and the axes to which they belong"
        )
    return ""


def checked_inertia(name: str, value: npt.ArrayLike) -> FloatArray:
    """Return the valid inertia tensor (3, 3), kg m^2, in the argument `name`, or raise ArgumentError."""
    tensor = finite_array(name, value, (3, 3))
    if problem := inertia_problem(tensor):
        raise ArgumentError(name, f"{brief(tensor.tolist())} {problem}")
    return tensor


def box_inertia(mass: float, size: Sequence[float]) -> FloatArray:
    """Return the inertia tensor (3, 3), kg m^2, of a homogeneous box of `mass` kg and `size` (3,), m."""
    squares = np.square(np.array(size, dtype=float))
    return np.asarray(np.diag(mass / 12.0 * (squares.sum() - squares)))
