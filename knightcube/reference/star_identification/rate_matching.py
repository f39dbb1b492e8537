"""Rate matching: stars are recognised by their common motion and identified by their predicted places.

Michalski 3.2.5 has a title and one reference, Samaan, Mortari & Junkins, Recursive mode star identification
algorithms (IEEE TAES 41, 2005); the method is built from these two. The ends of streaks, or two frames,
give each point its velocity across the sky. A star fixed in the sky moves as v' = -w x v with the one body
rate w that all stars share; satellites, hot pixels and planes do not and are excluded. A previous attitude,
turned by that rate, predicts each star's place; without one, the pyramid identifies the remaining points.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.reference.star_identification import pyramid
from knightcube.reference.star_identification.known_sky import KnownSky
from knightcube.reference.star_identification.search import search
from knightcube.reference.star_identification.settings import DEFAULT, ClassicalSettings
from knightcube.vision.startracker.identification.field import StarField
from knightcube.vision.startracker.identification.identification import Identification, Status
from knightcube.vision.startracker.identification.verification import nothing, verify_matrix


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """How the points of a field move across it.

    Attributes:
        velocity: (n, 3) 1/s, each direction's change with time, camera frame.
        sigma: (n,) 1/s, its standard deviation along one axis.
    """

    velocity: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Previous:
    """A previous attitude.

    Attributes:
        attitude: (4,) ICRS to camera.
        sigma: rad, its standard deviation about each axis, drift since then included.
        elapsed: s since then.
    """

    attitude: FloatArray
    sigma: float
    elapsed: float

    @property
    def part_of_all_attitudes(self) -> float:
        """The volume of the turns up to four sigmas, of that of all turns."""
        angle = min(4.0 * self.sigma, np.pi)
        return float(angle - np.sin(angle)) / np.pi


@dataclass(frozen=True, slots=True, eq=False)
class SharedRate:
    """The body rate of most points.

    Attributes:
        rate: (3,) rad/s, camera axes.
        covariance: (3, 3).
        shares: (n,) which points move by it.
    """

    rate: FloatArray
    covariance: FloatArray
    shares: BoolArray


_CHI_SQUARE = 13.8
"""Of two degrees of freedom; one star in a thousand lies beyond."""
_SEEDS = 10


def identify(
    field: StarField,
    sky: KnownSky,
    settings: ClassicalSettings = DEFAULT,
    motion: Motion | None = None,
    previous: Previous | None = None,
) -> Identification:
    """Return which points of a field are which stars.

    Without `motion` all points are taken for stars, and a `previous` attitude is taken not to have turned.
    Raises FieldUnknown if the scale is too uncertain, ValueError if motion and field differ in length.
    """
    shared = None if motion is None else shared_rate(field.direction, motion)
    kept = np.arange(len(field)) if shared is None else np.flatnonzero(shared.shares)
    stars = field.subset(kept)
    if len(stars) < settings.verification.least_matches:
        return nothing(field, Status.TOO_FEW_STARS)
    answer = nothing(stars)
    if previous is not None:
        turn = np.zeros(3) if shared is None else shared.rate * previous.elapsed
        predicted = attitude_matrix(multiply(from_rotation_vector(turn), previous.attitude))
        answer = verify_matrix(
            stars, sky.index, predicted, 1.0, previous.part_of_all_attitudes, settings.verification
        )
    if answer.status is not Status.IDENTIFIED:
        answer = search(stars, sky, pyramid.propose, settings)
    star = np.full(len(field), -1)
    star[kept] = answer.star
    return Identification(
        answer.status, star, answer.fix, answer.scale, answer.scale_sigma, answer.log10_false_alarm
    )


def shared_rate(direction: FloatArray, motion: Motion) -> SharedRate:
    """Return the body rate that most of the points (n, 3) share, by least squares over those.

    Two points fix a rate; of the rates of pairs among the first ten, that which most points agree with.
    Raises ValueError when motion and directions differ in length.
    """
    if len(motion.velocity) != len(direction):
        raise ValueError(f"{len(direction)} directions and {len(motion.velocity)} velocities: give one each")
    shares = np.zeros(len(direction), dtype=bool)
    none = SharedRate(np.zeros(3), np.full((3, 3), np.inf), shares)
    for pair in combinations(range(min(len(direction), _SEEDS)), 2):
        chosen = np.array(pair)
        rate, covariance = _rate(direction[chosen], motion.velocity[chosen], motion.sigma[chosen])
        agrees = _agrees(direction, motion, rate, covariance)
        if agrees.sum() <= shares.sum():
            continue
        # Two close points give a poor rate that many points agree with: a fit to all must hold too.
        rate, _ = _rate(direction[agrees], motion.velocity[agrees], motion.sigma[agrees])
        agrees = _agrees(direction, motion, rate, np.zeros((3, 3)))
        if agrees.sum() > shares.sum():
            shares = agrees
    for _ in range(3):
        if shares.sum() < 2:
            return none
        rate, covariance = _rate(direction[shares], motion.velocity[shares], motion.sigma[shares])
        shares = _agrees(direction, motion, rate, np.zeros((3, 3)))
    return SharedRate(rate, covariance, shares)


def _rate(direction: FloatArray, velocity: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rate (3,) of least squares and its covariance: v' = v x w, across v."""
    weight = 1.0 / sigma**2
    normal = np.sum(weight) * np.eye(3) - np.einsum("n,nx,ny->xy", weight, direction, direction)
    covariance = np.linalg.pinv(normal)
    return covariance @ (weight @ np.cross(velocity, direction)), covariance


def _agrees(direction: FloatArray, motion: Motion, rate: FloatArray, covariance: FloatArray) -> BoolArray:
    """Return which points (n,) move by `rate`, both errors considered."""
    residual = motion.velocity - np.cross(direction, rate)
    residual -= np.sum(residual * direction, axis=-1, keepdims=True) * direction
    # The largest variance that the rate's error gives to any direction across the line of sight.
    spread = motion.sigma**2 + float(np.linalg.eigvalsh(covariance)[-1]) * (1.0 - direction[:, 2] ** 2)
    spread = spread + float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    return np.asarray(np.sum(residual**2, axis=-1) <= _CHI_SQUARE * spread)
