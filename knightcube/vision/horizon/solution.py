"""The result for one picture: nadir in camera axes with its covariance, or the reason for none."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.directions import tangent_basis
from knightcube.vision.horizon.limb_equation import View


class HorizonStatus(Enum):
    """The outcome of the search for the horizon."""

    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    """Several fits are possible, or one may be the terminator: see the candidates."""
    NO_HORIZON = "no-horizon"
    """Too few edges, or none that lie on one horizon."""
    REFUSED = "refused"
    """A horizon was fitted but contradicts prior knowledge: see the reason."""


@dataclass(frozen=True, slots=True, eq=False)
class NadirMeasurement:
    """The direction to the Earth's centre from one horizon.

    Attributes:
        direction: (3,) unit vector in camera axes, towards the Earth's centre (geocentric nadir).
        covariance: (3, 3) rad^2, of the direction's error; of rank 2, nothing along the direction itself.
        altitude: m above the ellipsoid (or the sphere of the mean radius): given, or fitted where unknown.
        altitude_sigma: m.
        residual: px rms, normal to the fitted horizon, of the points used.
        used: number of points on the horizon.
    """

    direction: FloatArray
    covariance: FloatArray
    altitude: float
    altitude_sigma: float
    residual: float
    used: int

    @property
    def basis(self) -> FloatArray:
        """Two unit vectors (2, 3) normal to the direction and to one another."""
        return tangent_basis(self.direction)

    @property
    def tangent_covariance(self) -> FloatArray:
        """The covariance (2, 2) rad^2 along `basis`."""
        return np.asarray(self.basis @ self.covariance @ self.basis.T)

    @property
    def sigma(self) -> float:
        """The root of the mean variance over the two axes, rad."""
        return float(np.sqrt(0.5 * np.trace(self.covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class HorizonSolution:
    """The outcome of one picture.

    Attributes:
        nadir: the measurement, when the status is FOUND.
        candidates: the horizons that were not chosen; all of them if ambiguous.
        points: (n, 2) px, every edge from dark to bright that was found.
        on_horizon: (n,) whether the fit used them.
        limb: (k, 3) unit vectors in camera axes, where the fit places those edges.
        limb_sigma: (k,) rad, of each normal to the limb.
        view: the camera's place and attitude by the best fit, accepted or not; see `limb_in_picture`.
        pixels_read: number of pixels read.
    """

    status: HorizonStatus
    reason: str = ""
    nadir: NadirMeasurement | None = None
    candidates: tuple[NadirMeasurement, ...] = ()
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    on_horizon: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    limb: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    limb_sigma: FloatArray = field(default_factory=lambda: np.zeros(0))
    view: View | None = None
    pixels_read: int = 0
