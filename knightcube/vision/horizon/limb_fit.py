"""The robust fit of the limb's cone to edges: attitude, limb height and altitude with their covariance.

Gauss-Newton on `knightcube.vision.horizon.limb_equation` with exact gradients. Huber's weights, and none
beyond five spreads, exclude clouds, glare and the terminator's ends; the spread is that of the points (from
the median of their residuals) if it exceeds the stated one. Parameters that the limb does not determine - its
height, the turn about nadir, the altitude - have a prior, so that the covariance includes their uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.directions import tangent_basis
from knightcube.vision.horizon.limb_equation import (
    ALTITUDE,
    LIMB_HEIGHT,
    PARAMETERS,
    View,
    limb_gradients,
    limb_residuals,
)

_MOST_STEPS = 10
_LAST_STEP = 3e-5
"""rad: an eightieth of a pixel, and the next step would be far smaller."""
_SAME_GRADIENTS = 3e-3
"""rad: a step that changes the gradients by less than a hundredth."""
_HUBER = 1.5
_BEYOND = 5.0
_MOST_ALIKE = 0.8
"""Largest correlation of neighbours that is assumed."""
_TO_SIGMA = 1.4826
"""Of a normal distribution: standard deviation over the median of absolute values."""
UNKNOWN = 1e9
"""m: the spread of an unknown height."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Standard deviations of the first view: the turn about nadir in rad, limb height and altitude in m."""

    azimuth: float
    limb_height: float
    altitude: float = UNKNOWN


@dataclass(frozen=True, slots=True, eq=False)
class FittedLimb:
    """A view fitted to edges.

    Attributes:
        view: the best one.
        covariance: (5, 5) of the parameters of `View.moved`.
        residuals: (n,) rad, positive outside the limb.
        used: (n,) edges within five spreads.
        spread: factor by which the residuals exceed the stated ones, at least 1.
        cost: the sum of squares in units of the spread, of the used edges and the prior.
    """

    view: View
    covariance: FloatArray
    residuals: FloatArray
    used: BoolArray
    spread: float
    cost: float

    @property
    def nadir_covariance(self) -> FloatArray:
        """The covariance (3, 3) rad^2 of the direction to the Earth's centre in camera axes."""
        x, y, z = self.view.nadir
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.asarray(cross @ self.covariance[:3, :3] @ cross.T)

    def altitude_sigma(self, allowance: float) -> float:
        """Return the standard deviation of the altitude, m, with an `allowance` for unmodelled effects."""
        return float(np.hypot(np.sqrt(self.covariance[ALTITUDE, ALTITUDE]), allowance))


def fit_limb(start: View, rays: FloatArray, sigma: FloatArray, prior: Prior) -> FittedLimb | None:
    """Return the limb through rays (n, 3) of spreads (n,) rad, from a view near it.

    None if the edges do not determine the nadir, or the fit diverges.
    """
    information = _information(start, prior)
    view, moved = start, np.zeros(PARAMETERS)
    last = np.inf
    for number in range(_MOST_STEPS + 1):
        if last > _SAME_GRADIENTS:
            residuals, gradients = limb_gradients(view, rays)
        else:
            residuals = limb_residuals(view, rays)
        weights, spread, used = _weights(residuals, sigma)
        weighted = gradients * weights[:, None]
        normal = weighted.T @ gradients + information
        if last < _LAST_STEP or number == _MOST_STEPS:
            break
        step = _solved(normal, -(weighted.T @ residuals + information @ moved))
        if step is None:
            return None
        view, moved = view.moved(step), moved + step
        if not _sound(view):
            return None
        last = float(np.max(np.abs(step[:3])))
    points = (normal - information) / _alike(view.nadir, rays[used], (residuals / sigma)[used])
    covariance = _solved(points + information, np.eye(PARAMETERS))
    if covariance is None:
        return None
    cost = float(weights @ residuals**2 + moved @ information @ moved)
    return FittedLimb(view, covariance, residuals, used, spread, cost)


def shared_error(
    fit: FittedLimb, rays: FloatArray, sigma: FloatArray, prior: Prior, groups: IntArray, error: FloatArray
) -> FloatArray:
    """Return the covariance (5, 5) that errors shared by all points of a group add to a fit's.

    `groups` (n,) are the numbers of the rays' groups from 0, `error` (groups,) rad the standard deviation of
    each: the fit weighs its points as if none were shared.
    """
    _, gradients = limb_gradients(fit.view, rays)
    weighted = gradients * _weights(fit.residuals, sigma)[0][:, None]
    inverse = _solved(weighted.T @ gradients + _information(fit.view, prior), np.eye(PARAMETERS))
    assert inverse is not None  # the fit has solved these equations
    moved = np.array([inverse @ weighted[groups == k].sum(axis=0) for k in range(len(error))])
    return np.asarray((moved * (error**2)[:, None]).T @ moved)


def stepped(
    start: View, residuals: FloatArray, gradients: FloatArray, sigma: FloatArray, prior: Prior
) -> View | None:
    """Return the view after one step of `fit_limb`, its residuals (n,) and gradients (n, 5) being given."""
    weighted = gradients * _weights(residuals, sigma)[0][:, None]
    step = _solved(weighted.T @ gradients + _information(start, prior), -(weighted.T @ residuals))
    view = None if step is None else start.moved(step)
    return view if view is not None and _sound(view) else None


def _information(start: View, prior: Prior) -> FloatArray:
    nadir = start.nadir
    information = np.zeros((PARAMETERS, PARAMETERS))
    information[:3, :3] = np.outer(nadir, nadir) / prior.azimuth**2
    information[LIMB_HEIGHT, LIMB_HEIGHT] = prior.limb_height**-2
    information[ALTITUDE, ALTITUDE] = prior.altitude**-2
    return information


def _weights(residuals: FloatArray, sigma: FloatArray) -> tuple[FloatArray, float, BoolArray]:
    """Return weights (n,) rad^-2, the spread, and which edges count at all (n,)."""
    scaled = np.abs(residuals) / sigma
    middle = len(scaled) // 2
    spread = max(1.0, _TO_SIGMA * float(np.partition(scaled, middle)[middle]))
    scaled /= spread
    used = scaled <= _BEYOND
    huber = np.minimum(1.0, _HUBER / np.maximum(scaled, _HUBER))
    return huber * used / (sigma * spread) ** 2, spread, used


def _alike(nadir: FloatArray, rays: FloatArray, scaled: FloatArray) -> float:
    """Return the factor by which correlation raises the variance of the mean of residuals `scaled` (n,).

    Clouds and coasts behind the limb shift neighbouring points alike: for a first-order process with the
    correlation r of neighbours round the limb the factor is (1 + r)/(1 - r).
    """
    square = float(scaled @ scaled)
    if len(scaled) < 3 or square == 0.0:
        return 1.0
    aside = rays @ tangent_basis(nadir).T
    azimuth = np.arctan2(aside[:, 1], aside[:, 0])
    # Starting at the widest gap: the first and the last are not neighbours.
    order = np.argsort(azimuth)
    gaps = np.diff(azimuth[order], append=azimuth[order[0]] + 2.0 * np.pi)
    along = scaled[np.roll(order, -1 - int(np.argmax(gaps)))]
    alike = float(along[1:] @ along[:-1]) / square
    return (1.0 + (r := min(max(alike, 0.0), _MOST_ALIKE))) / (1.0 - r)


def _solved(normal: FloatArray, right: FloatArray) -> FloatArray | None:
    """Return the solution of normal equations whose unknowns have different units; None if singular."""
    diagonal = normal.diagonal()
    if not diagonal.min() > 0.0:
        return None
    scale = 1.0 / np.sqrt(diagonal)
    try:
        answer = scale * np.linalg.solve(normal * scale * scale[:, None], (right.T * scale).T).T
    except np.linalg.LinAlgError:
        return None
    answer = answer.T
    return np.asarray(answer) if np.isfinite(answer).all() else None


def _sound(view: View) -> bool:
    """Return whether the camera is still outside the surface on which the limb lies."""
    if view.surface.polar + view.limb_height <= 0.0:
        return False
    stretched = view.surface.stretching(view.limb_height) @ view.position
    return float(stretched @ stretched) > 1.0 + 1e-6
