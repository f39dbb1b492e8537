"""From candidate patterns to an identification: the common part of all classical methods.

A method yields batches of candidates: observed stars and the guide stars that they may be. Each candidate
gives an attitude. The brightest observed stars are transformed to the sky by it, and those that fall near
guide stars are counted. The candidates with the highest counts are verified against the whole field, which
rejects false candidates of any method. A field of uncertain scale is searched at several scales (`View`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.errors import FlightError
from knightcube.reference.star_tables import KnownSky, angles
from knightcube.vision.startracker.attitude_fit import (
    MatchStatus,
    StarField,
    StarMatch,
    stretched,
)
from knightcube.vision.startracker.verification import (
    VerificationSettings,
    nothing,
    verify,
)


@dataclass(frozen=True, slots=True)
class ClassicalSettings:
    """One set for all methods; each uses some of it.

    Attributes:
        brightest: observed stars of which patterns are made.
        tolerance: of an angle, an area or a moment, in its sigmas.
        patterns: triangles or pivots that are looked up in a table at most.
        joins: triangles made of pairs at most, over all scales: each takes half a millisecond, and a list
            without a match takes them all.
        candidates: of all patterns together, that are laid over the field at most: the budget of work.
        screened: observed stars, the brightest, that a candidate is laid over before it is verified.
        verified: candidates of a pattern that the whole field verifies at most.
        scale_step: relative half width of the scales that one look-up covers.
        scales: look-ups at most; a field that would need more is rejected.
        verification: when a candidate is accepted.
    """

    brightest: int = 11
    tolerance: float = 3.0
    patterns: int = 80
    joins: int = 24
    candidates: int = 2500
    screened: int = 14
    verified: int = 4
    scale_step: float = 0.002
    scales: int = 9
    verification: VerificationSettings = field(default_factory=VerificationSettings)


DEFAULT = ClassicalSettings()


class FieldUnknown(FlightError):
    """A field of view too uncertain for the classical methods; the default method solves those."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A field at one scale.

    Attributes:
        field: as given.
        scale: by which its tangents are multiplied here.
        direction: (n, 3) unit vectors, so multiplied.
        sigma: (n,) rad.
        slack: relative error of angles by the scale.
        stars: number of the brightest stars that patterns are made of.
    """

    field: StarField
    scale: float
    direction: FloatArray
    sigma: FloatArray
    slack: float
    stars: int

    def angles(
        self, one: IntArray, other: IntArray, tolerance: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the angles (k,) between observed stars, and the limits (k,), (k,) of the true ones.

        The limits are `tolerance` sigmas (31: the variances of the two along their arc add up) and the slack.
        """
        angle = angles(self.direction[one], self.direction[other])
        off = tolerance * np.hypot(self.sigma[one], self.sigma[other]) + self.slack * angle
        return angle, angle - off, angle + off


def views(field: StarField, settings: ClassicalSettings) -> Iterator[View]:
    """Yield the field at the scales that cover its range, the likeliest first.

    Raises FieldUnknown when the range needs more of them than the settings allow.
    """
    low, high = (math.log(edge) for edge in field.scale)
    steps = max(1, math.ceil((high - low) / (2.0 * settings.scale_step) - 1e-9))
    if steps > settings.scales:
        known = 100.0 * settings.scales * settings.scale_step
        raise FieldUnknown(
            f"scale known to {50.0 * (high - low):.1f} %: the classical methods need {known:.1f} %;"
            " the default method takes any"
        )
    edges = np.linspace(low, high, steps + 1)
    middles = 0.5 * (edges[1:] + edges[:-1])
    for middle in middles[np.argsort(np.abs(middles - 0.5 * (low + high)), kind="stable")]:
        scale = math.exp(middle)
        yield View(
            field,
            scale,
            stretched(field.direction, scale),
            field.sigma * scale,
            0.5 * (high - low) / steps,
            min(settings.brightest, len(field)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Patterns of observed stars that look like patterns of guide stars.

    Attributes:
        observed: (k, m) numbers of observed stars, m >= 2, the first two far apart: they fix the attitude.
        star: (k, m) numbers of guide stars.
    """

    observed: IntArray
    star: IntArray

    def __len__(self) -> int:
        return len(self.observed)


_LEAST_BASE = 10.0
"""Of a candidate's first two stars, in sigmas of a direction."""
_LEAST_JOINS = 4
Propose = Callable[[View, KnownSky, ClassicalSettings], Iterator[Candidates]]


def search(
    field: StarField, sky: KnownSky, propose: Propose, settings: ClassicalSettings = DEFAULT
) -> StarMatch:
    """Return the first candidate of `propose` that the whole field verifies, within the budget of work.

    Raises FieldUnknown when the scale of the field is known too badly.
    """
    if len(field) < settings.verification.least_matches:
        return nothing(field, MatchStatus.TOO_FEW_STARS)
    steps = list(views(field, settings))
    settings = replace(settings, joins=max(_LEAST_JOINS, settings.joins // len(steps)))
    for view in steps:
        spent = 0
        for candidates in propose(view, sky, settings):
            taken = min(len(candidates), settings.candidates - spent)
            spent += taken
            answer = _best(view, sky, candidates, taken, settings)
            if answer is not None:
                return answer
            if spent >= settings.candidates:
                break
    return nothing(field)


def _best(
    view: View, sky: KnownSky, candidates: Candidates, taken: int, settings: ClassicalSettings
) -> StarMatch | None:
    """Return the first of the `taken` candidates that holds, those that most stars support first."""
    if not taken:
        return None
    observed, star = candidates.observed[:taken], candidates.star[:taken]
    # Points within their errors of one another fix no attitude, nor does one guide star taken twice.
    base = view.direction[observed[:, 0]] - view.direction[observed[:, 1]]
    apart = np.linalg.norm(base, axis=-1) > _LEAST_BASE * view.sigma.max()
    apart &= star[:, 0] != star[:, 1]
    if not apart.any():
        return None
    observed, star = observed[apart], star[apart]
    matrices = attitudes(view.direction[observed[:, :2]], sky.stars.direction[star[:, :2]])
    support = _support(view, sky, matrices, observed, settings)
    least = min(settings.verification.least_matches, len(view.direction))
    for number in np.argsort(-support, kind="stable")[: settings.verified]:
        if support[number] < least:
            return None
        answer = verify(
            view.field,
            sky.index,
            matrices[number],
            view.scale,
            settings=settings.verification,
        )
        if answer.status is MatchStatus.IDENTIFIED:
            return answer
    return None


def attitudes(observed: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the attitudes (k, 3, 3) that lay pairs (k, 2, 3) on one another, middle on middle."""
    return np.swapaxes(_frames(observed), -1, -2) @ _frames(reference)


def _frames(pairs: FloatArray) -> FloatArray:
    middle = pairs[:, 0] + pairs[:, 1]
    along = pairs[:, 0] - pairs[:, 1]
    middle = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    return np.stack([middle, along, np.cross(middle, along)], axis=1)


def _support(
    view: View, sky: KnownSky, matrices: FloatArray, observed: IntArray, settings: ClassicalSettings
) -> IntArray:
    """Return how many of the brightest observed stars each attitude (k, 3, 3) lays near a guide star."""
    seen = view.direction[: settings.screened]
    pair = view.direction[observed[:, :2]]
    base = np.linalg.norm(pair[:, 0] - pair[:, 1], axis=-1)
    middle = 0.5 * (pair[:, 0] + pair[:, 1])
    lever = np.linalg.norm(seen[None] - middle[:, None], axis=-1)
    sigma = float(view.sigma.max())
    # The turn that the base's two errors leave acts on the lever; each star has an error of its own.
    gate = settings.tolerance * sigma * np.sqrt(1.5 + 2.0 * (lever / base[:, None]) ** 2)
    gate = np.minimum(gate + view.slack * lever, 0.25 * math.atan(min(sky.half_width)))
    distance, _ = sky.tree.query(seen @ matrices, distance_upper_bound=float(gate.max()))
    return np.asarray((distance <= gate).sum(axis=1))
