"""From constants per inertia to inertia, torque constant, stiffness and damping.

Motion under a known current shows g = n A B / J, k / J and c / J, never J itself: a body of twice the inertia
in twice the field on twice the thread moves alike. The scale comes from prior values of the inertia and of
the dipole per ampere n A, each with its error, and from the field, by prior and by magnetometer.
The prior is Gaussian in the logarithms; g ties the three together (a measurement without error of
ln n A + ln B - ln J - ln g = 0, all of them uncertain). Each is drawn towards what the other two say of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ground.identification.constants import NAMES
from ground.identification.fit import PlantFit
from ground.identification.record import FieldMeasurement
from knightcube.astro.arrays import FloatArray

_MOTION = tuple(NAMES.index(name) for name in ("gain", "torsion", "damping"))
_TIE = np.array([-1.0, 1.0, 1.0, -1.0, 0.0, 0.0])  # on ln J, ln n A, ln B, ln g, kappa, delta


@dataclass(frozen=True, slots=True)
class Belief:
    """A value and its relative standard deviation."""

    value: float
    error: float


@dataclass(frozen=True, slots=True)
class Beliefs:
    """The values known before the flight, with their errors.

    Attributes:
        inertia: kg m^2.
        dipole: n A, m^2, of the coil on x per ampere that is commanded.
        field: T.
        magnetometer_error: relative standard deviation of the magnetometer's scale.
    """

    inertia: Belief
    dipole: Belief
    field: Belief
    magnetometer_error: float


@dataclass(frozen=True, slots=True)
class Known:
    """A value, its standard deviation, and the part of it that the flight's motion did not add.

    `own_prior` is the derivative of the value's logarithm by that of what was known of this very quantity
    without the motion: 1 where that added nothing. None where nothing was known.
    """

    value: float
    sigma: float
    own_prior: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AbsolutePlant:
    """The constants of `knightcube.gnc.guidance.one_axis.plant` with their errors.

    Attributes:
        inertia, dipole, field: kg m^2, m^2, T.
        torque_constant: n A B, N m/A.
        stiffness, damping: N m/rad, N m s/rad.
        field_measured: by the magnetometer; otherwise believed only.
        covariance: (6, 6) of (ln inertia, ln dipole, ln field, ln gain, torsion, damping), gain, torsion and
            damping being those of the fit.
    """

    inertia: Known
    dipole: Known
    field: Known
    torque_constant: Known
    stiffness: Known
    damping: Known
    field_measured: bool
    covariance: FloatArray

    def rests_on(self) -> dict[str, str]:
        """Return the sources of each constant, by name."""
        prior = "believed before"
        field = "magnetometer and belief" if self.field_measured else prior

        def divided(known: Known, own: str, others: str) -> str:
            share = 100.0 * (known.own_prior or 0.0)
            return f"{share:.0f} % {own}, {100.0 - share:.0f} % {others} by the motion"

        ratio = "the motion, times the inertia"
        return {
            "inertia": divided(self.inertia, prior, "dipole and field"),
            "dipole": divided(self.dipole, prior, "inertia and field"),
            "field": divided(self.field, field, "inertia and dipole"),
            "torque_constant": ratio,
            "stiffness": ratio,
            "damping": ratio,
        }


def absolute(found: PlantFit, beliefs: Beliefs, measured: FieldMeasurement | None) -> AbsolutePlant:
    """Return the plant that fit, beliefs and the measured field make together."""
    field = _field(beliefs, measured)
    before = beliefs.inertia, beliefs.dipole, field
    constants = found.constants
    mean = np.array(
        [*(math.log(b.value) for b in before), math.log(constants.gain), constants.torsion, constants.damping]
    )
    per_unit = np.array([1.0 / constants.gain, 1.0, 1.0])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag([b.error**2 for b in before])
    covariance[3:, 3:] = found.covariance[np.ix_(_MOTION, _MOTION)] * np.outer(per_unit, per_unit)
    spread = float(_TIE @ covariance @ _TIE)
    correction = covariance @ _TIE / spread
    mean = mean - correction * float(_TIE @ mean)
    shares = [1.0 - float(covariance[i, i]) / spread for i in range(3)]
    covariance = covariance - np.outer(correction, _TIE @ covariance)
    inertia, dipole, strength = (float(value) for value in np.exp(mean[:3]))
    torsion, damping = float(mean[4]), float(mean[5])
    sigma = [math.sqrt(float(covariance[i, i])) for i in range(3)]
    return AbsolutePlant(
        inertia=Known(inertia, inertia * sigma[0], shares[0]),
        dipole=Known(dipole, dipole * sigma[1], shares[1]),
        field=Known(strength, strength * sigma[2], shares[2]),
        torque_constant=_known(dipole * strength, covariance, {1: dipole * strength, 2: dipole * strength}),
        stiffness=_known(inertia * torsion, covariance, {0: inertia * torsion, 4: inertia}),
        damping=_known(inertia * damping, covariance, {0: inertia * damping, 5: inertia}),
        field_measured=measured is not None,
        covariance=covariance,
    )


def _field(beliefs: Beliefs, measured: FieldMeasurement | None) -> Belief:
    """Return the field by belief and magnetometer together."""
    believed = beliefs.field
    if measured is None or measured.magnitude <= 0.0:
        return believed
    error = math.hypot(beliefs.magnetometer_error, measured.sigma / measured.magnitude)
    weights = np.array([believed.error, error]) ** -2.0
    logarithm = weights @ np.log([believed.value, measured.magnitude]) / np.sum(weights)
    return Belief(float(np.exp(logarithm)), float(np.sum(weights) ** -0.5))


def _known(value: float, covariance: FloatArray, gradient: dict[int, float]) -> Known:
    by = np.zeros(len(covariance))
    for index, derivative in gradient.items():
        by[index] = derivative
    return Known(value, math.sqrt(float(by @ covariance @ by)))
