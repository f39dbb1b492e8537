"""The error state of a Kalman filter as a list of blocks, with covariance propagation and update.

The filters of the testbed (`attitude_filter`) and of the satellite (`free_filter`) declare two different
lists of blocks. Both filters use the covariance propagation and the Kalman update of this module.

Each block is a vector with a name, a prior covariance, a random walk and a role. An estimated block is
corrected by measurements. A considered block (Schmidt 1966) is not corrected, but its uncertainty and its
correlations enter the gains and the covariance of all other blocks. A fixed block is known exactly. The role
of a block can be changed without a change of the filter's equations.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.errors import ArgumentError, UsageError


class Role(Enum):
    """Treatment of a block of the error state."""

    ESTIMATED = "estimated"
    CONSIDERED = "considered"
    FIXED = "fixed"


@dataclass(frozen=True, slots=True, eq=False)
class StateBlock:
    """A block of n elements of the error state.

    Attributes:
        name: name of the block, unique within the list.
        prior: initial standard deviations (n,) or initial covariance (n, n).
        walk: standard deviations (n,) of the random walk per sqrt(s), or one number for all elements.
        role: whether the block is estimated, considered or fixed.
    """

    name: str
    prior: FloatArray
    walk: FloatArray | float = 0.0
    role: Role = Role.ESTIMATED


def slices(sizes: Mapping[str, int]) -> list[slice]:
    """Return the slices of consecutive blocks with the given numbers of elements."""
    ends = np.cumsum(list(sizes.values())).tolist()
    return [slice(end - size, end) for end, size in zip(ends, sizes.values(), strict=True)]


class ErrorState:
    """The layout of an error state.

    Attributes:
        sizes: number of elements of each block by name, in order.
        size: number of elements of the error state.
        prior: initial covariance (size, size), with zeros for fixed blocks.
        walks: variances (size,) of the random walks per second, with zeros for fixed blocks.
        considered: flags (size,) of the elements of considered blocks, or None if no block is considered.
    """

    def __init__(self, blocks: Sequence[StateBlock]) -> None:
        """Concatenate the blocks. Raises UsageError if two blocks have the same name."""
        self.sizes = {block.name: len(block.prior) for block in blocks}
        if len(self.sizes) < len(blocks):
            raise UsageError(f"two blocks of the error state have the same name: {[b.name for b in blocks]}")
        self.size = sum(self.sizes.values())
        self.prior: FloatArray = np.zeros((self.size, self.size))
        self.walks: FloatArray = np.zeros(self.size)
        considered: BoolArray = np.zeros(self.size, dtype=bool)
        for block, at in zip(blocks, slices(self.sizes), strict=True):
            if block.role is Role.FIXED:
                continue
            self.prior[at, at] = block.prior if np.ndim(block.prior) == 2 else np.diag(block.prior**2)
            self.walks[at] = np.square(block.walk)
            considered[at] = block.role is Role.CONSIDERED
        self.considered = considered if considered.any() else None

    def estimated(self, gain: FloatArray) -> FloatArray:
        """Return the gain (size, k) with zeros for the considered elements, which are not corrected."""
        return gain if self.considered is None else np.where(self.considered[:, None], 0.0, gain)


class Weighed(NamedTuple):
    """The optimal gain (n, k) for an innovation of k components and n states, with intermediate results.

    The intermediate results are the normalised square `square` = y' S^-1 y of the innovation y, the
    covariance `cross` (n, k) of states and innovation, and the covariance `spread` S (k, k) of the
    innovation.
    """

    square: float
    gain: FloatArray
    cross: FloatArray
    spread: FloatArray


def weigh(covariance: FloatArray, value: FloatArray, rows: FloatArray, noise: FloatArray) -> Weighed:
    """Return the optimal gain for an innovation `value` (k,), where k is at most 3.

    The innovation has the Jacobian `rows` (k, n). The states have the covariance `covariance` (n, n), and the
    measurement has the covariance `noise` (k, k).
    """
    # For small matrices, ndarray.dot takes two thirds of the time of the @ operator.
    cross = covariance.dot(rows.T)
    spread = rows.dot(cross) + noise
    weight = _inverted(spread)
    return Weighed(float(value.dot(weight).dot(value)), cross.dot(weight), cross, spread)


def direction_error(observed: FloatArray, expected: FloatArray, across: FloatArray) -> FloatArray:
    """Return the deviation (2,), rad, of an observed direction (3,) from an expected direction (3,).

    The components are along the rows of `across` (2, 3), which are normal to the expected direction. Up to a
    right angle, the length of the deviation is the sine of the angle between the directions. At larger
    angles, the length is the angle itself, because the sine would make an opposite direction appear correct.
    """
    error = np.asarray(across @ observed)
    if float(expected @ observed) < 0.0:
        sine = math.hypot(*error.tolist())
        angle = math.atan2(sine, float(expected @ observed))
        return error * (angle / sine) if sine > 0.0 else np.array((angle, 0.0))
    return error


def updated(covariance: FloatArray, gain: FloatArray, cross: FloatArray, spread: FloatArray) -> FloatArray:
    """Return the covariance (n, n) of the states after a correction with any gain (n, k).

    The arguments `cross` and `spread` are the attributes of `Weighed` with these names. The result equals
    Joseph's form, also for a gain that is not optimal, such as one with zero rows for considered elements.
    """
    half = gain.dot((cross - 0.5 * gain.dot(spread)).T)
    covariance = covariance - half - half.T
    return np.asarray(0.5 * (covariance + covariance.T))


def propagated(
    covariance: FloatArray, flow: FloatArray, seconds: float, density: FloatArray, walks: FloatArray
) -> FloatArray:
    """Return the covariance (n, n) after a step of `seconds`, in which only attitude and rate have dynamics.

    The first six states are attitude and rate. The argument `flow` (6, k) is the part of the error dynamics F
    with the rows for attitude and rate and the columns for the first k states. The spectral density of the
    angular acceleration is `density` (3, 3), rad^2/s^3. The random walks of the first k states have the
    variances `walks` (k,) per second. States beyond the first k do not change. The transition matrix is I + F
    dt + (F dt)^2 / 2.
    """
    size = flow.shape[1]
    flow = seconds * flow
    # Only attitude and rate have nonzero rows in F, so F^2 needs only the columns of attitude and rate.
    half = 0.5 * flow[:, _MOTION] + _IDENTITY
    transition = half.dot(flow)
    transition[:, _MOTION] += _IDENTITY
    moved = transition.dot(covariance[:size])
    among = moved[:, :size].dot(transition.T)
    # White noise of the angular acceleration adds to the covariance of attitude and rate.
    of_attitude, of_both = seconds**3 / 3.0, 0.5 * seconds * seconds
    over = np.array((of_attitude, of_both, of_both, seconds)).reshape(2, 1, 2, 1)
    among += (over * density[:, np.newaxis]).reshape(6, 6)
    after = covariance.copy()
    after[_MOTION], after[:, _MOTION], after[_MOTION, _MOTION] = moved, moved.T, among
    after.reshape(-1)[: size * len(after) : len(after) + 1] += seconds * walks
    return after


def reset(covariance: FloatArray, at: slice, rotation: Sequence[float]) -> None:
    """Transform the covariance of an attitude error in place to the axes after the correction.

    The slice `at` of the error state is the attitude error, which was corrected by `rotation` (3,), rad. To
    first order, the remaining error rotates by half the correction (Markley and Crassidis 2014, 6.2.4).
    """
    x, y, z = rotation
    turn = np.array(((1.0, 0.5 * z, -0.5 * y), (-0.5 * z, 1.0, 0.5 * x), (0.5 * y, -0.5 * x, 1.0)))
    moved = turn.dot(covariance[at])
    among = moved[:, at].dot(turn.T)
    covariance[at], covariance[:, at] = moved, moved.T
    covariance[at, at] = 0.5 * (among + among.T)


def widen(covariance: FloatArray, at: IntArray, prior: FloatArray) -> None:
    """Reset, in place, the covariance of the states with indices `at` (k,) to `prior` (k, k).

    The states count as unknown again, so they are not correlated with any other state.
    """
    covariance[at] = covariance[:, at] = 0.0
    covariance[np.ix_(at, at)] = prior


def keep_scale(covariance: FloatArray, at: slice, values: FloatArray, change: FloatArray) -> None:
    """Preserve, in place, the uncertainty of the common scale of some states after their correction.

    If no measurement depends on the common scale, the vector of the scaled states is itself the unobservable
    direction in state space. The correction `change` (n,) of the error state changes the unobservable
    direction, so the covariance is adjusted to the new direction. Without the adjustment of the covariance,
    each correction would reduce the uncertainty of the scale. The slice `at` of the error state contains the
    states with the common scale, whose values before the correction are `values` (m,).
    """
    along = values / (values @ values)
    covariance += np.outer(change, along @ covariance[at])
    covariance += np.outer(covariance[:, at] @ along, change)


_MOTION = slice(0, 6)
"""Indices of attitude and rate in the error state of a filter."""
_IDENTITY: FloatArray = np.eye(6)


def joined(covariance: FloatArray, by_states: FloatArray, first: FloatArray) -> FloatArray:
    """Return the initial covariance (n, n) if attitude and rate depend on the other states.

    The array `by_states` (6, n) contains the derivatives of the errors of attitude and rate with respect to
    the states. The matrix `first` (6, 6) is the covariance of attitude and rate if all other states are known
    exactly.
    """
    whole = covariance.copy()
    whole[:6] = by_states @ covariance
    whole[:, :6] = whole[:6].T
    whole[:6, :6] = whole[:6] @ by_states.T + first
    return whole


PLAUSIBLE = 4.0
"""Largest plausible deviation of an estimated state from its configured value, in standard deviations."""


def plausible(values: FloatArray, variances: FloatArray) -> BoolArray:
    """Return flags (k,): whether each estimated state is plausible for its initial variance."""
    return np.asarray(np.abs(values) <= PLAUSIBLE * np.sqrt(variances))


CONTRADICTED, PAUSE = 60.0, 600.0
"""Time (s) over which innovations are evaluated, and time (s) after a contradiction during which innovations
are ignored."""
_LARGEST, _MEAN, _LEAST = chi_square.bound(0.001, 3), 5.0, 40
"""Value at which normalised squared innovations are clipped, largest mean of consistent squared innovations,
and minimum number of innovations for a decision."""


class PriorCheck:
    """Test whether mutually consistent measurements contradict the estimated states.

    The states are contradicted if the normalised squared innovations in `CONTRADICTED` seconds have a mean
    above 5; the expected mean is 3. Each squared innovation is clipped at the value that one in a thousand
    consistent innovations exceeds, so that a few outliers cause no contradiction.
    """

    def __init__(self) -> None:
        self._begun, self._least_time = 0.0, -math.inf
        self._number, self._sum = 0, 0.0

    def add(self, time: float, square: float) -> bool:
        """Add the normalised square of an innovation with three components at a time (s).

        Return whether the innovations contradict the estimated states. After a contradiction, innovations are
        ignored for `PAUSE` seconds.
        """
        if not time >= self._least_time or math.isnan(square):
            return False
        if not self._number:
            self._begun = time
        self._number, self._sum = self._number + 1, self._sum + min(square, _LARGEST)
        if time - self._begun < CONTRADICTED or self._number < _LEAST:
            return False
        is_contradicted = self._sum > _MEAN * self._number
        self._least_time = time + PAUSE if is_contradicted else time
        self._number, self._sum = 0, 0.0
        return is_contradicted


_SHAPES = {"int": ((),), "float": ((),), "tuple[float, float]": ((2,),), "float | FloatArray": ((), (3,))}
"""Permitted shapes of the settings that `check_amounts` checks, by their annotation."""


def check_amounts(settings: Any, *positive: str) -> None:
    """Raise ArgumentError unless the numbers in the fields of a dataclass are finite and not negative.

    The fields named in `positive` must be above zero, and fields annotated as int must be whole numbers. Each
    checked field contains one number, a pair of numbers, or either one number or an array (3,).
    """
    for field in dataclasses.fields(settings):
        value, shapes = getattr(settings, field.name), _SHAPES.get(str(field.type))
        if shapes is None:
            continue
        kinds, above = "iu" if field.type == "int" else "iuf", field.name in positive
        found = np.asarray(value)
        right = found.dtype.kind in kinds and found.shape in shapes and np.isfinite(found).all()
        if not (right and (found > 0 if above else found >= 0).all()):
            counts = {(): "a number", (2,): "two numbers", (3,): "three numbers"}
            kind, least = "whole" if kinds == "iu" else "finite", "above zero" if above else "of 0 or more"
            what = " or ".join(counts[shape] for shape in shapes).replace("number", f"{kind} number")
            raise ArgumentError(field.name, f"{value!r}: give {what} {least}")


def gate_bounds(sigma: float) -> dict[int, float]:
    """Return the largest accepted normalised square of an innovation with 1, 2 and 3 components.

    The probability that this value is exceeded equals that of a normal deviation of more than `sigma`
    standard deviations.
    """
    chance = math.erfc(sigma / math.sqrt(2.0))
    return {components: chi_square.bound(chance, components) for components in (1, 2, 3)}


def _inverted(s: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric (1, 1), (2, 2) or (3, 3) matrix, by cofactors.

    The inverse of a singular matrix is not finite, so that an innovation with this covariance is rejected.
    """
    if len(s) == 1:
        return np.asarray(1.0 / s)
    if len(s) == 2:
        (a, b), (_, d) = s.tolist()
        scale = 1.0 / ((a * d - b * b) or math.nan)
        return np.array(((scale * d, -scale * b), (-scale * b, scale * a)))
    (a, b, c), (_, d, e), (_, _, f) = s.tolist()
    ca, cb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    cd, ce, cf = a * f - c * c, b * c - a * e, a * d - b * b
    scale = 1.0 / ((a * ca + b * cb + c * cc) or math.nan)
    return np.asarray(np.array(((ca, cb, cc), (cb, cd, ce), (cc, ce, cf))) * scale)


def with_role(blocks: Sequence[StateBlock], roles: Mapping[str, Role]) -> list[StateBlock]:
    """Return the blocks of an error state with some roles replaced.

    The mapping `roles` assigns new roles to names of blocks. Raises UsageError for an unknown name.
    """
    unknown = sorted(roles.keys() - {block.name for block in blocks})
    if unknown:
        raise UsageError(f"the error state has no block {', '.join(unknown)}")
    return [dataclasses.replace(block, role=roles.get(block.name, block.role)) for block in blocks]
