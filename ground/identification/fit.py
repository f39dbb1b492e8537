"""The constants that explain a record best: Gauss-Newton on the innovations' likelihood, noise included.

Constants and noise levels are found in turn (their information matrices do not mix): the constants from the
whitened innovations, the noise by Fisher scoring. Priors are wide and only keep apart what a dull record
leaves open: the delay is some 20 ms, the noise levels are known to a factor of three.

The covariance is the inverse of the information. It holds where the innovations are white, which is tested
(Ljung and Box 1978). Where they are not - the unit's own attitude filter, a draught - each deviation is what
the scatter of the score over stretches of the record says (the sandwich estimate, Huber 1967), if larger.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincc

from ground.identification.constants import NAMES, Constants, Noise
from ground.identification.innovations import Innovations, innovations
from ground.identification.record import IdentificationError, Record
from knightcube.astro.arrays import FloatArray

PRIOR_SIGMA = Constants(
    gain=math.inf, torsion=math.inf, damping=math.inf, disturbance=1.0, bias=0.1, delay=0.02
)
_NOISE_PRIOR = math.log(3.0)
_LONGEST_DELAY = 0.1
_CONVERGED = 0.01
_ROUNDS = 25
_NOISE_STEP = 0.02
_NOISE_SETTLED = 0.01
_GATES = (30.0, 8.0)  # in believed, then in found standard deviations
_MOST_RESTARTS = 0.02
_LAGS = 20
_STRETCHES = 40
_SUSPICIOUS = 1e-3
_LEAST_KNOWN = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Whiteness:
    """The test of the innovations: variance in units of the expected, and how probable their correlation is.

    Each of angle and rate; `probability` is that of a correlation over 20 lags as strong, were they white.
    """

    variance: tuple[float, float]
    probability: tuple[float, float]

    @property
    def passed(self) -> bool:
        """Whether nothing speaks against white innovations."""
        return min(self.probability) > _SUSPICIOUS


@dataclass(frozen=True, slots=True, eq=False)
class PlantFit:
    """The constants, `covariance` (6, 6) in their order, the noise found, the innovations and their test."""

    constants: Constants
    covariance: FloatArray
    noise: Noise
    innovations: Innovations
    whiteness: Whiteness

    def sigma(self, name: str) -> float:
        """Return the standard deviation of the constant of that name."""
        index = NAMES.index(name)
        return math.sqrt(float(self.covariance[index, index]))


def fit(record: Record, noise: Noise, progress: Callable[[int, float], None] | None = None) -> PlantFit:
    """Fit the constants to `record`; `noise` is its assumed noise.

    `progress` is called with the number of each round and its step in standard deviations. Raises
    IdentificationError when the record does not determine the torque constant, or nothing explains it.
    """
    if not np.any(record.current):
        raise IdentificationError("the coil on x was never driven: nothing in this flight shows its torque")
    try:
        return _fitted(record, noise, progress)
    except (ValueError, OverflowError) as error:
        # What a prediction without bounds ends in: the cosine of infinity, a covariance that is none.
        raise IdentificationError("no constants explain this flight: their prediction runs away") from error


def _fitted(record: Record, noise: Noise, progress: Callable[[int, float], None] | None) -> PlantFit:
    constants, believed, share, before = first_guess(record), noise, 1.0, np.zeros(len(NAMES))
    restarts: frozenset[int] = frozenset()
    gates = list(_GATES)
    for count in range(_ROUNDS):
        passed = innovations(record, constants, noise, restarts)
        step, information = _step(passed, constants)
        # The delay has a kink wherever a switch passes over a sample: where steps turn back, go half as far.
        share *= 0.5 if step @ information @ before < 0.0 and count > 3 else 1.0
        before = step
        step = share * step
        largest = float(np.max(np.abs(step) * np.sqrt(np.diag(information))))
        constants = _moved(constants, step)
        if progress is not None:
            progress(count, largest)
        if largest > 3.0 and count < 2:
            continue
        if len(gates) == len(_GATES):
            restarts = _gone_over(record, constants, noise, restarts, gates.pop(0))
        likelier = _noise(record, constants, noise, believed, restarts)
        settled = float(np.max(np.abs(likelier.to_logarithms() - noise.to_logarithms()))) < _NOISE_SETTLED
        noise = likelier
        if settled and largest < _CONVERGED:
            seen = _gone_over(record, constants, noise, restarts, gates.pop(0)) if gates else restarts
            if seen == restarts:
                return _finished(record, constants, noise, restarts)
            restarts = seen
    raise IdentificationError(
        f"no constants explain this flight: after {_ROUNDS} rounds the last step was still "
        f"{largest:.2g} standard deviations"
    )


def first_guess(record: Record) -> Constants:
    """Return gain, torsion, damping and disturbance by regression of the rate's change over each second.

    Of noise it knows nothing, but it needs no start.
    """
    spans = np.diff(record.time)
    at = np.searchsorted(record.switch_time, record.time[:-1], side="right")
    current = np.append(0.0, record.current)[at]
    middle = 0.5 * (record.angle[1:] + record.angle[:-1])
    mean_rate = 0.5 * (record.rate[1:] + record.rate[:-1])
    sums = np.cumsum(
        [spans * c for c in (current * np.cos(middle), -middle, -mean_rate, np.ones(len(spans)))], 1
    )
    edges = np.unique(np.searchsorted(record.time, np.arange(record.time[0], record.time[-1])))[1:]
    changes = np.diff(record.rate[edges])
    found = np.linalg.lstsq(np.diff(sums[:, edges - 1], axis=1).T, changes, rcond=None)[0]
    return Constants(*(float(value) for value in found))


def _gone_over(
    record: Record, constants: Constants, noise: Noise, restarts: frozenset[int], gate: float
) -> frozenset[int]:
    """Return `restarts` and where else no noise explains what happened. Raises IdentificationError."""
    passed = innovations(record, constants, noise, restarts, gate, with_gradient=False)
    if len(passed.restarts) > _MOST_RESTARTS * len(record.time):
        raise IdentificationError(
            f"no constants explain this flight: {len(passed.restarts)} of {len(record.time)} samples are "
            f"more than {gate:g} standard deviations from what the motion before them says"
        )
    return passed.restarts


def _finished(record: Record, constants: Constants, noise: Noise, restarts: frozenset[int]) -> PlantFit:
    passed = innovations(record, constants, noise, restarts)
    _, information = _step(passed, constants)
    covariance = _inverse(information)
    whiteness = _whiteness(passed.whitened)
    if not whiteness.passed:
        covariance = _widened(covariance, passed)
    made = PlantFit(constants, covariance, noise, passed, whiteness)
    sigma = made.sigma("gain")
    if sigma > _LEAST_KNOWN * abs(constants.gain):
        raise IdentificationError(
            f"this flight leaves the torque constant open ({constants.gain:.3g} +- {sigma:.2g} rad/s^2/A): "
            "it needs more current, or more time"
        )
    if constants.gain < 0.0:
        raise IdentificationError(
            f"the coil on x turns the body the other way ({constants.gain:.3g} +- {sigma:.2g} rad/s^2/A): "
            "look at `coils.signs` and at the direction of the field"
        )
    return made


def _step(passed: Innovations, constants: Constants) -> tuple[FloatArray, FloatArray]:
    """Return the Gauss-Newton step (6,) and the information (6, 6) that it rests on."""
    j = passed.whiten(passed.gradient).reshape(-1, len(NAMES))
    prior = PRIOR_SIGMA.to_array() ** -2.0
    information = j.T @ j + np.diag(prior)
    right = j.T @ passed.whitened.reshape(-1) - np.where(prior > 0.0, prior * _off_prior(constants), 0.0)
    return _inverse(information) @ right, information


def _off_prior(constants: Constants) -> FloatArray:
    off = constants.to_array()
    off[:3] = 0.0
    return off


def _moved(constants: Constants, step: FloatArray) -> Constants:
    values = constants.to_array() + step
    values[-1] = min(max(values[-1], -_LONGEST_DELAY), _LONGEST_DELAY)
    return Constants.of(values)


def _inverse(information: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric matrix whose units differ widely. Raises IdentificationError."""
    scale = 1.0 / np.sqrt(np.diag(information))
    correlation = information * np.outer(scale, scale)
    if not np.all(np.isfinite(correlation)) or np.linalg.cond(correlation) > 1e12:
        raise IdentificationError("the constants cannot be separated: the body hardly moved")
    return np.asarray(np.linalg.inv(correlation) * np.outer(scale, scale))


def _noise(
    record: Record, constants: Constants, noise: Noise, believed: Noise, restarts: frozenset[int]
) -> Noise:
    """Return noise levels one step of Fisher scoring nearer to the likeliest."""
    at = noise.to_logarithms()
    here = innovations(record, constants, noise, restarts, with_gradient=False)
    inverse = np.linalg.inv(here.covariance)
    weighted = np.einsum("nij,nj->ni", inverse, here.error)
    error_by, covariance_by = [], []
    for index in range(len(at)):
        moved = at.copy()
        moved[index] += _NOISE_STEP
        there = innovations(record, constants, Noise.of_logarithms(moved), restarts, with_gradient=False)
        error_by.append((there.error - here.error) / _NOISE_STEP)
        covariance_by.append((there.covariance - here.covariance) / _NOISE_STEP)
    score, relative = [], [inverse @ change for change in covariance_by]
    for error, change, ratio in zip(error_by, covariance_by, relative, strict=True):
        quadratic = np.einsum("ni,nij,nj->", weighted, change, weighted)
        trace = np.einsum("nii->", ratio)
        score.append(0.5 * (quadratic - trace) - np.sum(weighted * error))
    information = np.array(
        [
            [
                0.5 * np.einsum("nij,nji->", relative[i], relative[k])
                + np.einsum("ni,nij,nj->", error_by[i], inverse, error_by[k])
                for k in range(len(at))
            ]
            for i in range(len(at))
        ]
    )
    right = np.array(score) - (at - believed.to_logarithms()) / _NOISE_PRIOR**2
    step = np.linalg.solve(information + np.eye(len(at)) / _NOISE_PRIOR**2, right)
    return Noise.of_logarithms(at + np.clip(step, -1.0, 1.0))


def _whiteness(whitened: FloatArray) -> Whiteness:
    """Test each column of (n, 2) by Ljung and Box."""
    count = len(whitened)
    variance = np.mean(whitened**2, axis=0)
    lags = np.arange(1, _LAGS + 1)
    correlation = np.array([np.sum(whitened[lag:] * whitened[:-lag], axis=0) for lag in lags.tolist()]) / (
        count * variance
    )
    q = count * (count + 2.0) * np.sum(correlation**2 / (count - lags)[:, None], axis=0)
    angle, rate = gammaincc(0.5 * _LAGS, 0.5 * q).tolist()
    return Whiteness((float(variance[0]), float(variance[1])), (angle, rate))


def _widened(covariance: FloatArray, passed: Innovations) -> FloatArray:
    """Return `covariance` with the deviations that the score's scatter over stretches asks for, if larger."""
    scores = np.einsum("nik,ni->nk", passed.whiten(passed.gradient), passed.whitened)
    stretches = np.array([np.sum(part, axis=0) for part in np.array_split(scores, _STRETCHES)])
    sandwich = covariance @ (stretches.T @ stretches) @ covariance
    wider = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(covariance), 1.0))
    return np.asarray(covariance * np.outer(wider, wider))
