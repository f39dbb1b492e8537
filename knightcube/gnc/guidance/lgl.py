"""Legendre-Gauss-Lobatto nodes: quadrature, differentiation and interpolation of polynomials on [-1, 1].

The pseudospectral discretisation of Sease 2013, 5.8. With n nodes the nodes are the roots of
(1 - x^2) P'(x), P the Legendre polynomial of degree n - 1; quadrature is exact to degree 2n - 3, the
differentiation matrix to degree n - 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre

from knightcube.astro.arrays import FloatArray
from knightcube.errors import UsageError


@dataclass(frozen=True, slots=True)
class LglRule:
    """One set of nodes; the arrays are read-only because rules are shared.

    Attributes:
        nodes: (n,) ascending, from -1 to 1.
        weights: (n,) of the quadrature; their sum is 2.
        differentiation: (n, n) from values on the nodes to derivatives on the nodes.
        barycentric: (n,) weights of Lagrange interpolation through the nodes.
    """

    nodes: FloatArray
    weights: FloatArray
    differentiation: FloatArray
    barycentric: FloatArray

    def interpolation(self, points: FloatArray) -> FloatArray:
        """Return the matrix (m, n) from values on the nodes to values at `points` (m,) in [-1, 1]."""
        difference = np.asarray(points, dtype=float)[:, None] - self.nodes
        hit = difference == 0.0
        terms = self.barycentric / np.where(hit, 1.0, difference)
        rows = terms / terms.sum(axis=1, keepdims=True)
        return np.asarray(np.where(hit.any(axis=1, keepdims=True), hit.astype(float), rows))


@lru_cache(maxsize=32)
def lgl_rule(count: int) -> LglRule:
    """Return the rule of `count` >= 2 nodes; raises UsageError below that."""
    if count < 2:
        raise UsageError(f"{count} Legendre-Gauss-Lobatto nodes: at least 2, the ends, are needed")
    degree = count - 1
    series = legendre.Legendre.basis(degree)
    inner = np.sort(np.real(series.deriv().roots()))
    slope, curvature = series.deriv(), series.deriv(2)
    for _ in range(3):  # the companion matrix is good to about 1e-12; Newton refines to rounding
        inner = inner - slope(inner) / curvature(inner)
    nodes = np.concatenate([[-1.0], 0.5 * (inner - inner[::-1]), [1.0]])

    values = series(nodes)
    weights = 2.0 / (degree * (degree + 1) * values**2)
    barycentric = 1.0 / values
    gap = nodes[:, None] - nodes + np.eye(count)
    differentiation = barycentric / barycentric[:, None] / gap
    # The diagonal is minus the sum of its row, so that the derivative of a constant is zero to rounding.
    np.fill_diagonal(differentiation, 0.0)
    np.fill_diagonal(differentiation, -differentiation.sum(axis=1))
    for array in (nodes, weights, differentiation, barycentric):
        array.setflags(write=False)
    return LglRule(nodes, weights, differentiation, barycentric)
