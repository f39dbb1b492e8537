"""The paths that virtual motion camouflage searches: q2 = q_r + v (q_p - q_r) on N nodes (Sease 5.10-5.12).

A path is the polynomial of degree N - 1 through its node values, so q2', q2'' and the current are exact
between nodes too. v is 1 at both ends; v_2 and v_(N-1) follow from the boundary rates, derived
from q' = D q at the ends (5.11 corrected): N - 4 path control parameters are free.

The prey is affine in the horizon T and a path is affine in v - 1 at a fixed prey. Writing the paths as
prey(T) + M y, with the columns of M the changes that leave the ends and their slopes alone, scaled by
(q_p - q_r) and whitened, gives every optimisation here affine trajectories and well-conditioned variables.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.gnc.guidance.lgl import LglRule, lgl_rule
from knightcube.gnc.guidance.one_axis.prey import CubicPrey

DENSE_POINTS = 769


@dataclass(frozen=True, slots=True)
class Samples:
    """Points (m,) to evaluate paths at, and matrices (3, m, N) from nodes to q2, dq2/ds and d2q2/ds2."""

    points: FloatArray
    matrices: FloatArray

    @classmethod
    def at(cls, rule: LglRule, points: FloatArray) -> Samples:
        """Return the samples of polynomials on `rule` at `points` (m,) in [-1, 1]."""
        value = rule.interpolation(points)
        slope = value @ rule.differentiation
        return cls(points, np.stack([value, slope, slope @ rule.differentiation]))

    def take(self, index: IntArray) -> Samples:
        """Return the samples at the points of `index`."""
        return Samples(self.points[index], self.matrices[:, index])


@dataclass(frozen=True, slots=True)
class Discretisation:
    """Matrices that depend on the number of nodes only.

    Attributes:
        rule: the N nodes.
        cost: samples on 2 N LGL nodes, where the energy is integrated: I^2 has about twice the path's degree,
            so that N nodes leave an error for the optimiser to exploit.
        cost_weights: (2 N,) of that quadrature, their sum 2.
        dense: samples where the limits are checked, denser towards the ends as the extrema are.
        free: (N, N - 4) from the free nodes' changes to all nodes' changes, ends and end slopes unchanged.
    """

    rule: LglRule
    cost: Samples
    cost_weights: FloatArray
    dense: Samples
    free: FloatArray


@lru_cache(maxsize=8)
def discretisation(count: int) -> Discretisation:
    """Return the discretisation on `count` >= 6 nodes."""
    rule = lgl_rule(count)
    fine = lgl_rule(2 * count)
    dense = -np.cos(np.linspace(0.0, np.pi, DENSE_POINTS))
    slopes = rule.differentiation[[0, -1]]
    # 5.11, 5.12: the two nodes next to the ends change so that q' at the ends does not.
    next_to_ends = np.linalg.solve(slopes[:, [1, -2]], -slopes[:, 2:-2])
    free = np.zeros((count, count - 4))
    free[2:-2] = np.eye(count - 4)
    free[[1, -2]] = next_to_ends
    return Discretisation(rule, Samples.at(rule, fine.nodes), fine.weights, Samples.at(rule, dense), free)


@dataclass(frozen=True, slots=True)
class Boundary:
    """The states a path joins: q2 and q2' (1/s) at both ends."""

    start: float
    start_slope: float
    end: float
    end_slope: float

    def prey(self, horizon: float) -> CubicPrey:
        """Return the prey path over `horizon` s."""
        return CubicPrey.between(self.start, self.start_slope, self.end, self.end_slope, horizon)


@dataclass(frozen=True, slots=True)
class Family:
    """All paths between two states on N nodes: prey at rest + T * prey of the slopes + basis @ y.

    Attributes:
        grid: the discretisation.
        still: (N,) the prey with both slopes zero, which no horizon changes.
        drift: (N,) change of the prey per second of horizon, through its end slopes.
        basis: (N, N - 4) node changes for each parameter y.
    """

    grid: Discretisation
    still: FloatArray
    drift: FloatArray
    basis: FloatArray

    @classmethod
    def around(cls, boundary: Boundary, horizon: float, reference: float, count: int) -> Family:
        """Return the family with y = v - 1 on the free nodes, v measured against the prey over `horizon`."""
        grid = discretisation(count)
        fraction = 0.5 * (grid.rule.nodes + 1.0)
        still = CubicPrey.between(boundary.start, 0.0, boundary.end, 0.0, 1.0).q2(fraction)
        drift = CubicPrey.between(0.0, boundary.start_slope, 0.0, boundary.end_slope, 1.0).q2(fraction)
        to_reference = (still + horizon * drift - reference)[2:-2]
        return cls(grid, still, drift, grid.free * to_reference)

    @property
    def size(self) -> int:
        """The number of free path control parameters, N - 4."""
        return int(self.basis.shape[1])

    @property
    def farthest_end(self) -> float:
        """The larger |q2| of the two ends."""
        return float(np.abs(self.still[[0, -1]]).max())

    def remixed(self, mixing: FloatArray) -> Family:
        """Return the same paths under new parameters: y_old = mixing @ y_new, mixing (N - 4, N - 4)."""
        return Family(self.grid, self.still, self.drift, self.basis @ mixing)

    def nodes(self, parameters: FloatArray, horizon: float) -> FloatArray:
        """Return q2 on the nodes (N,)."""
        return np.asarray(self.still + horizon * self.drift + self.basis @ parameters)

    def observed(self, samples: Samples) -> Observed:
        """Return the family evaluated at `samples`."""
        matrices = samples.matrices
        return Observed(matrices @ self.still, matrices @ self.drift, matrices @ self.basis)


@dataclass(frozen=True, slots=True)
class Observed:
    """A family at m points: q2, dq2/ds, d2q2/ds2, affine in horizon and parameters: (3, m[, N - 4])."""

    still: FloatArray
    drift: FloatArray
    basis: FloatArray

    def trajectory(self, parameters: FloatArray, horizon: float) -> FloatArray:
        """Return q2, q2' in 1/s and q2'' in 1/s^2 (3, m)."""
        return time_scale(horizon) * (self.still + horizon * self.drift + self.basis @ parameters)

    def aging(self, trajectory: FloatArray, horizon: float) -> FloatArray:
        """Return the derivative of `trajectory` (3, m) by the horizon, in units of the s-derivatives.

        A longer horizon changes the prey and lowers the factors from s-derivatives to time derivatives.
        """
        slower = np.array([[0.0], [-1.0], [-2.0]]) / (horizon * time_scale(horizon))
        return np.asarray(self.drift + slower * trajectory)


def time_scale(horizon: float) -> FloatArray:
    """Return the factors (3, 1) from s-derivatives to time derivatives: s grows by 2 in `horizon` s (5.8)."""
    per_second = 2.0 / horizon
    return np.array([[1.0], [per_second], [per_second * per_second]])
