"""Nadir from the Earth's limb in one image, or in the images of several cameras.

    solution = find_nadir(image, camera, HorizonKnowledge(position=..., sun=..., attitude=...))
    if solution:
        filter.update(solution.nadir.direction, solution.nadir.covariance, -position)

`find_nadir` finds edges on scan lines and cones with which many edges agree, and fits the ellipsoid's limb to
the edges of each cone. Each fitted limb is tested against the number of edges expected by chance, the width
of the atmosphere's brightness profile, the darkness of space, the brightness of the whole image, the coarse
sensors and the rough attitude. If exactly one limb passes all tests, it gives the nadir. Otherwise the image
is ambiguous or refused, and the result contains the reason.

The function `nadir_of_cameras` first searches each image alone (Meller et al., chapter 4, use three or four
cameras). The nadirs found by different cameras must agree. An image that gave no nadir, or several nadirs, is
searched again with the nadir of the other cameras as prior knowledge. One common limb is fitted to the limb
points of all images. The unknown height of the limb above the ground displaces the nadir only if the images
show one side of the limb but not the opposite side.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from knightcube.astro import chi_square
from knightcube.astro.arrays import BoolArray, FloatArray, Image, check_type, tangent_basis
from knightcube.astro.quaternion import multiply
from knightcube.errors import ArgumentError
from knightcube.vision.camera.lens import CameraModel, MountedCamera, check_shape, image_of_camera
from knightcube.vision.horizon.edges import ImagePart, Levels, Observation, ScanLines, find_edges, observe
from knightcube.vision.horizon.hypothesis import Hypothesis, examine, near_limb, prior_of
from knightcube.vision.horizon.initial_guess import (
    MOST_MISMATCH,
    SPHERE_ALTITUDE_SIGMA,
    ConeCandidate,
    InitialGuess,
    Place,
    above_sphere,
    best_cone,
    initial_guess,
    left_free,
    limb_tilt_sigma,
    orientation,
    place_of,
)
from knightcube.vision.horizon.limb import (
    ALTITUDE,
    UNIT_DEPTH_HEIGHT,
    UNKNOWN,
    FittedLimb,
    LimbView,
    fit_limb,
    shared_error,
)
from knightcube.vision.horizon.settings import (
    EdgeSettings,
    HorizonKnowledge,
    HorizonSettings,
    RoughAttitude,
    SensedDirection,
)


class HorizonStatus(Enum):
    """The outcome of the search for the horizon."""

    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    """Several different horizons are consistent with the image."""
    NO_HORIZON = "no-horizon"
    """The image has too few edges, or its edges do not lie on a common horizon."""
    REFUSED = "refused"
    """A horizon was fitted but contradicts the image or prior knowledge."""


@dataclass(frozen=True, slots=True, eq=False)
class NadirMeasurement:
    """The direction to the Earth's centre, measured from one horizon.

    Attributes:
        direction: unit vector (3,) towards the Earth's centre (geocentric nadir), camera axes.
        covariance: covariance (3, 3) of the direction's error, rad^2, zero along the direction (rank 2).
        altitude: height above the ellipsoid, or above the mean sphere if the position is unknown, m.
        altitude_sigma: standard deviation of the altitude, m.
        residual: rms distance of the used points from the fitted horizon, px.
        used: number of limb points from which the horizon was fitted.
    """

    direction: FloatArray
    covariance: FloatArray
    altitude: float
    altitude_sigma: float
    residual: float
    used: int

    @property
    def basis(self) -> FloatArray:
        """Two unit vectors (2, 3) normal to the nadir direction and to each other."""
        return tangent_basis(self.direction)

    @property
    def tangent_covariance(self) -> FloatArray:
        """The covariance (2, 2) of the nadir direction along the two vectors of `basis`, rad^2."""
        return np.asarray(self.basis @ self.covariance @ self.basis.T)

    @property
    def sigma(self) -> float:
        """The standard deviation of the nadir direction, as the rms over two axes, rad."""
        return float(np.sqrt(0.5 * np.trace(self.covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class HorizonSolution:
    """The result of the horizon search in one image, which is true (`if solution:`) if a nadir was found.

    Attributes:
        status: outcome of the search.
        reason: why no nadir was found, in one sentence; empty if a nadir was found.
        nadir: the measured nadir, or None unless the status is FOUND.
        candidates: nadirs of the horizons that were not selected, or of all horizons if no nadir was found.
        points: positions of all edges from dark to bright (n, 2), px.
        on_horizon: mask of the edges that lie on the best horizon (n,).
        limb: unit vectors (k, 3) to the limb points on the best horizon, camera axes.
        limb_sigma: standard deviations of the limb points normal to the limb (k,), rad.
        view: position and attitude of the camera from the best fit, even if refused, or None without a fit.
        pixels_read: number of pixels that the search read.
    """

    status: HorizonStatus
    reason: str = ""
    nadir: NadirMeasurement | None = None
    candidates: tuple[NadirMeasurement, ...] = ()
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    on_horizon: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    limb: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    limb_sigma: FloatArray = field(default_factory=lambda: np.zeros(0))
    view: LimbView | None = None
    pixels_read: int = 0

    def __bool__(self) -> bool:
        """Return whether a nadir was found."""
        return self.nadir is not None

    def __repr__(self) -> str:
        """Return status, nadir and uncertainty, or the reason, in one line."""
        if self.nadir is None:
            return f"<HorizonSolution {self.status.value}: {self.reason}>"
        nadir = ", ".join(f"{value:.5f}" for value in self.nadir.direction)
        sigma = math.degrees(math.sqrt(np.linalg.eigvalsh(self.nadir.covariance)[-1]))
        return f"<HorizonSolution {self.status.value}: nadir [{nadir}], 1 sigma {sigma:.2g} deg>"


_WIDER = 2.0
"""Factor that widens the altitude range in the search for cones. A cone through three edges is inaccurate."""
_MOST_ALTITUDE = 3.0
"""Largest difference (standard deviations) between the altitude that the edges imply and prior knowledge."""
_STRAY, _COVERED, _NIGHT = 0.05, 0.6, 0.1
"""Thresholds of three tests that a horizon must pass.

The first threshold is the largest fraction of bright samples in the sky and on the night side. The second
threshold is the minimum coverage of the sunlit limb by edges. The third threshold is the largest fraction of
limb points on the night side.
"""
_RIVAL = 0.3
"""Fraction of the best horizon's edge count above which a second horizon makes the result ambiguous."""
_SAME = np.radians(1.0)
"""Angle (rad) between two nadirs from one image below which they count as the same nadir."""
_MOST_CHANCE = -6.0
"""Largest accepted log10 of the expected number of equally good horizons that edges form by chance."""
_BREADTH = 0.125, 2.0
"""Minimum and maximum ratio of the width of the limb's edges to that of the atmosphere's brightness profile.
"""
_OFF = 9.0
"""Upper limit of an edge's chi-square in the comparison of the horizons of different trial focal lengths."""
_GAIN = 1.5
"""Minimum ratio by which a second search on more scan lines must increase the number of horizon edges."""


def find_nadir(
    image: Image,
    camera: CameraModel,
    knowledge: HorizonKnowledge | None = None,
    settings: HorizonSettings | None = None,
    hidden: BoolArray | None = None,
) -> HorizonSolution:
    """Return the nadir from the Earth's limb in an image, or the reason why no nadir is found.

    The first search reads few columns and rows of the image. If the first search finds a horizon with few
    edges, a second search reads more columns and rows near this horizon. If the first search finds edges but
    no horizon, a second search reads more columns and rows of the whole image.

    Args:
        image: pixel values (rows, columns) of any integer or floating type; a larger value is brighter.
        camera: camera model of the image, a `Pinhole` or `Lens` of `knightcube.vision.camera.lens`.
        knowledge: prior knowledge of position, altitude, Sun and attitude. If `knowledge` contains neither
            position nor altitude, the altitude is fitted too.
        settings: settings of the search, or None for the defaults.
        hidden: mask of the pixels that show the spacecraft's own structure (rows, columns), or None.

    Raises:
        ArgumentError: if the size of image or mask differs from the camera's, if pixels are not finite, or if
            the mask contains values other than Booleans and integers. An integer other than 0 is true.

    Source: Meller et al., chapter 3; the fit of the limb follows Christian & Robinson 2016.
    """
    knowledge, settings = _given(knowledge, settings)
    return _find(_ScannedImage(image, camera, hidden), knowledge, settings)


def _given(
    knowledge: HorizonKnowledge | None, settings: HorizonSettings | None
) -> tuple[HorizonKnowledge, HorizonSettings]:
    """Return the arguments of a search or their defaults. Raises ArgumentError for other types."""
    knowledge = HorizonKnowledge() if knowledge is None else knowledge
    settings = HorizonSettings() if settings is None else settings
    check_type("knowledge", knowledge, HorizonKnowledge)
    check_type("settings", settings, HorizonSettings)
    return knowledge, settings


def _mask(hidden: ArrayLike, camera: CameraModel) -> BoolArray:
    """Return the argument `hidden` of `find_nadir` as a mask (rows, columns). Raises ArgumentError."""
    try:
        mask = np.asarray(hidden)
    except ValueError:
        raise ArgumentError("hidden", "rows of different lengths: give an array of Booleans") from None
    if mask.dtype.kind not in "biu":
        raise ArgumentError("hidden", f"pixels of {mask.dtype}: give Booleans, such as hidden > 0")
    check_shape(mask, camera, "hidden")
    return np.asarray(mask != 0)


def _find(
    image: _ScannedImage, knowledge: HorizonKnowledge, settings: HorizonSettings, is_last: bool = True
) -> HorizonSolution:
    """Return the result of `find_nadir`.

    The reason for a refusal is determined only if this search is the last search of the image (`is_last`).
    """
    search = _search(image, knowledge, settings, is_last=False)
    found = search.solution()
    if found.nadir is not None and found.nadir.used >= settings.enough_edges:
        return found
    if len(found.points) < settings.some_edges:
        return found
    again = replace(settings, edges=replace(settings.edges, lines=settings.edges.more_lines))
    read = found.pixels_read
    if found.nadir is not None:
        closer = _closer_search(search, image, knowledge, again)
        read += closer.read
        second = closer.solution()
        if second.nadir is not None and second.nadir.used >= _GAIN * found.nadir.used:
            # The first search has already compared this horizon with the other horizons in the image.
            return replace(second, candidates=found.candidates, pixels_read=read)
    second = _search(image, knowledge, again, is_last).solution()
    return replace(second, pixels_read=read + second.pixels_read)


_MOST_LOST, _LOST_STEP = 0.25, 16
"""Largest fraction of the rows that count as lost, and step between the pixels that are compared first."""


def _lost_rows(image: Image) -> BoolArray:
    """Return the mask (rows,) of rows that were lost in the transfer of an image.

    All pixels of a lost row are equal, such as zero, and differ from the medians of the nearest other rows
    above and below. Rows of the dark sky may be equal too, but the median of the next row is then the same.
    """
    lost: BoolArray = np.all(image[:, ::_LOST_STEP] == image[:, :1], axis=1)
    lost[lost] = np.all(image[lost] == image[lost, :1], axis=1)
    other = np.flatnonzero(~lost)
    if not lost.any() or not len(other):
        return np.zeros(len(image), dtype=np.bool_)
    lost[: other[0]] = lost[other[-1] :] = False
    rows = np.flatnonzero(lost)
    below = np.searchsorted(other, rows)
    beside = np.median(image[other[[below - 1, below]]], axis=2)
    lost[rows] = (beside != image[rows, 0]).all(axis=0)
    return np.asarray(lost & (np.count_nonzero(lost) <= _MOST_LOST * len(image)))


class _ScannedImage:
    """An image whose edges and cones are kept for further searches with other knowledge of directions."""

    def __init__(self, image: Image, camera: CameraModel, hidden: BoolArray | None) -> None:
        """Keep an image and its mask. Raises ArgumentError for the same reasons as `find_nadir`."""
        self.image = image_of_camera(image, camera)
        self.camera, self.hidden = camera, None if hidden is None else _mask(hidden, camera)
        lost = _lost_rows(self.image)
        if lost.any():
            rows = np.broadcast_to(lost[:, None], self.image.shape)
            self.hidden = np.array(rows if self.hidden is None else self.hidden | rows)
        self._observed: dict[int, tuple[Observation, ScanLines, list[_FreeCone]]] = {}

    def observed(self, settings: EdgeSettings) -> tuple[Observation, ScanLines, list[_FreeCone]]:
        """Return edges and scan lines of the whole image, and the best cones fitted so far."""
        if settings.lines not in self._observed:
            edges, lines = find_edges(self.image, settings, hidden=self.hidden)
            self._observed[settings.lines] = observe(edges, lines, self.camera), lines, []
        return self._observed[settings.lines]


@dataclass(frozen=True, slots=True, eq=False)
class _FreeCone:
    """The best cone through the edges that earlier cones have left free, or None.

    The number of free edges on the cone is `count`. The mask `free` (n,) marks the edges that remain free.
    """

    cone: ConeCandidate | None
    count: int
    free: BoolArray


_FIELD_STEPS: FloatArray = np.linspace(-2.5, 2.5, 11)
"""Trial focal lengths, as deviations from the most probable focal length in standard deviations."""
_FIELD_ROUNDS, _RESOLVED = 4, 0.3
"""Maximum number of rounds of trial focal lengths, and spread, as a fraction of `width`, that ends them.

The deviations of the trial focal lengths are `_FIELD_STEPS` times `width`. Another round with a smaller
`width` follows, unless the weighted spread of the trials exceeds the given fraction.
"""
_MOST_REFUSED = 0.5
"""Largest accepted total probability of the trial focal lengths whose horizons are refused."""


def nadir_of_uncertain_field(
    image: Image,
    camera: CameraModel,
    sigma: float,
    knowledge: HorizonKnowledge | None = None,
    settings: HorizonSettings | None = None,
    hidden: BoolArray | None = None,
) -> HorizonSolution:
    """Return the nadir if the camera's focal length has the relative standard deviation `sigma`.

    Nadir and altitude are weighted means over the horizons of eleven trial focal lengths. The weight of a
    horizon is the probability of its focal length and of its misfit. The uncertainty of each mean includes
    the scatter of the individual horizons. Refused horizons also contribute to the means, but the image is
    refused if refused horizons have half of the total weight or more. See `find_nadir`.
    """
    knowledge, settings = _given(knowledge, settings)
    first = find_nadir(image, camera, knowledge, settings, hidden)
    if len(first.points) < settings.some_edges:
        return first
    edges = settings.edges
    for lines in (edges.lines, edges.more_lines):
        settings = replace(settings, edges=replace(edges, lines=lines))
        trials, weights = _by_field(image, camera, sigma, knowledge, settings, hidden)
        if max((each.nadir.used for each in trials if each.solution), default=0) >= settings.enough_edges:
            break
    sound = np.array([bool(each.solution) for each in trials], dtype=bool)
    if weights[sound].sum() <= _MOST_REFUSED:
        if trials:
            return trials[int(np.argmax(np.where(sound, 0.0, weights)))].solution
        reason = first.reason or "no limb is found with any field of view within the uncertainty"
        status = HorizonStatus.REFUSED if first.nadir is not None else first.status
        return replace(first, status=status, reason=reason, nadir=None)
    nadirs = [trial.nadir for trial in trials]
    directions = np.array([each.direction for each in nadirs])
    mean = weights @ directions
    mean /= np.linalg.norm(mean)
    off = (directions - mean) @ (np.eye(3) - np.outer(mean, mean))
    covariance = np.einsum("k,kij->ij", weights, np.array([each.covariance for each in nadirs]))
    altitudes = np.array([[each.altitude, each.altitude_sigma] for each in nadirs])
    altitude = float(weights @ altitudes[:, 0])
    variance = float(weights @ (altitudes[:, 1] ** 2 + (altitudes[:, 0] - altitude) ** 2))
    best = trials[int(np.argmax(np.where(sound, weights, 0.0)))]
    nadir = replace(
        best.nadir,
        direction=mean,
        covariance=covariance + (off * weights[:, None]).T @ off,
        altitude=altitude,
        altitude_sigma=math.sqrt(variance),
    )
    return replace(best.solution, nadir=nadir)


@dataclass(frozen=True, slots=True, eq=False)
class _FieldTrial:
    """The best horizon of a search with a trial focal length, and its nadir, even if it was refused."""

    solution: HorizonSolution
    nadir: NadirMeasurement
    horizon: Hypothesis


def _by_field(
    image: Image,
    camera: CameraModel,
    sigma: float,
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
    hidden: BoolArray | None,
) -> tuple[list[_FieldTrial], FloatArray]:
    """Return the best horizon at each trial focal length, and the weights of these horizons.

    Horizons that contradict prior knowledge are omitted.
    """
    centre, width = 0.0, 1.0
    trials: list[_FieldTrial] = []
    weights = np.zeros(0)
    for _ in range(_FIELD_ROUNDS):
        steps, trials = [], []
        for step in centre + width * _FIELD_STEPS:
            rescaled = camera.rescaled(math.exp(step * sigma))
            search = _search(_ScannedImage(image, rescaled, hidden), knowledge, settings)
            if search.hypotheses and not _contradiction(search.hypotheses[0]):
                best = search.hypotheses[0]
                steps.append(step)
                trials.append(_FieldTrial(search.solution(), search.measured(best), best))
        if not trials:
            break
        places = np.array(steps)
        squares = np.array([each.horizon.squares for each in trials])
        # Only edges whose distance from the horizon is known for all focal lengths are compared.
        squares = np.minimum(squares[:, ~np.isnan(squares).any(axis=0)], _OFF)
        loss = squares.sum(axis=1)
        # All misfits are divided by the misfit and the correlation of the best fit, which ground and clouds
        # raise.
        best_fit = int(np.argmin(loss))
        on = squares[best_fit] < _OFF
        mean = float(squares[best_fit][on].sum()) / max(int(np.count_nonzero(on)), 1)
        scatter = max(1.0, mean) * trials[best_fit].horizon.fit.correlation
        prior = np.array([each.horizon.fit.prior for each in trials])
        cost = places**2 + loss / scatter + prior
        weights = np.exp(-0.5 * (cost - cost.min()))
        weights /= weights.sum()
        centre = float(weights @ places)
        spread = math.sqrt(float(weights @ (places - centre) ** 2))
        if spread > _RESOLVED * width or len(trials) == 1:
            break
        width = max(spread, 0.25 * width)
    return trials, weights


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """Result of one search: horizons, the best first, number of pixels read, and range of altitudes, m."""

    observation: Observation
    levels: Levels
    hypotheses: list[Hypothesis]
    read: int
    altitudes: tuple[float, float]

    def solution(self) -> HorizonSolution:
        """Return the result of the horizon search."""
        points, hypotheses = self.observation.edges.points, self.hypotheses
        if not hypotheses or hypotheses[0].not_space:
            reason = f"no significant horizon among {len(points)} edges"
            if hypotheses:
                reason = f"the best line of edges is not the limb: {hypotheses[0].not_space}"
            return HorizonSolution(
                HorizonStatus.NO_HORIZON,
                reason,
                points=points,
                on_horizon=np.zeros(len(points), dtype=bool),
                pixels_read=self.read,
            )
        status, reason = _judged(hypotheses, points[:, 1])
        best, found = hypotheses[0], status is HorizonStatus.FOUND
        measured = [self.measured(each) for each in hypotheses]
        return HorizonSolution(
            status,
            reason,
            measured[0] if found else None,
            tuple(measured[1:] if found else measured),
            points,
            best.members,
            best.limb.rays,
            best.limb.sigma,
            best.fit.view,
            self.read,
        )

    def measured(self, one: Hypothesis) -> NadirMeasurement:
        """Return the nadir of a horizon."""
        return _measurement(one.fit, one.covariance, one.guess.place, self.altitudes, one.residual)


def _search(
    image: _ScannedImage, knowledge: HorizonKnowledge, settings: HorizonSettings, is_last: bool = True
) -> _Search:
    """Search a whole image for horizons."""
    observation, lines, cones = image.observed(settings.edges)
    # Another search follows only if the image has some edges.
    is_last = is_last or len(observation.edges) < settings.some_edges
    hypotheses = _hypotheses(observation, cones, knowledge, settings, image.camera, is_last)
    return _Search(observation, lines.levels, hypotheses, lines.pixels, settings.altitudes)


def _closer_search(
    search: _Search, image: _ScannedImage, knowledge: HorizonKnowledge, settings: HorizonSettings
) -> _Search:
    """Search an image again near the best horizon of a first search, on more scan lines."""
    best, before = search.hypotheses[0], search.observation
    points = before.edges.points[best.members]
    box = np.stack([points.min(axis=0) - before.space, points.max(axis=0) + before.space])
    edges, lines = find_edges(image.image, settings.edges, ImagePart(box, search.levels), before.hidden)
    # The samples of the first search are used again, because they cover the whole image.
    observation = observe(edges, lines, image.camera, before.samples)
    members = near_limb(best.fit.view, observation, 2.0 * settings.tolerance)
    again = replace(best.guess, view=best.fit.view, members=members)
    found = examine(again, observation, knowledge, settings, image.camera)
    hypotheses = [] if found is None or not _is_limb(found) else [found]
    return _Search(observation, search.levels, hypotheses, lines.pixels, settings.altitudes)


def _hypotheses(
    observation: Observation,
    cones: list[_FreeCone],
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
    camera: CameraModel,
    is_last: bool,
) -> list[Hypothesis]:
    """Return the horizons found in the image, the best first.

    A horizon is fitted to the edges that agree with each of the best cones. Accepted horizons come before
    refused horizons, and horizons with more edges before horizons with fewer edges. The list `cones` contains
    the best cones of earlier searches. Cones that this search adds are appended to the list.
    """
    place = place_of(knowledge, settings)
    free = np.ones(len(observation.edges), dtype=bool)
    sound: list[Hypothesis] = []
    contradicted: list[InitialGuess] = []
    # Cones with so few edges that they cannot make an accepted horizon ambiguous are skipped.
    enough = float(settings.least_edges)
    for number in range(settings.candidates):
        if np.count_nonzero(free) < enough:
            break
        if number == len(cones):
            cones.append(_next_cone(observation, free, place, settings))
        cone, free = cones[number].cone, cones[number].free
        if cone is None or cones[number].count < enough:
            break
        guess = initial_guess(cone, observation, place, knowledge)
        if guess.orientation.mismatch > MOST_MISMATCH:
            contradicted.append(guess)
            continue
        found = examine(guess, observation, knowledge, settings, camera)
        if found is not None and _is_limb(found):
            sound.append(found)
            if not _flaw(found):
                enough = max(enough, _RIVAL * np.count_nonzero(found.members))
    if is_last and all(_flaw(each) for each in sound):
        # Initial guesses that contradict prior knowledge are fitted only to report why they are refused.
        fitted = (examine(each, observation, knowledge, settings, camera) for each in contradicted)
        sound += [each for each in fitted if each is not None and _is_limb(each)]
    return sorted(sound, key=lambda each: (_flaw(each) != "", -np.count_nonzero(each.members)))


def _next_cone(
    observation: Observation, free: BoolArray, place: Place | None, settings: HorizonSettings
) -> _FreeCone:
    """Return the best cone through the edges in the mask `free` (n,)."""
    if place is None:
        least, most = settings.altitudes
        low, high = (above_sphere(altitude).cosine for altitude in (least / _WIDER, most * _WIDER))
    else:
        low = high = place.cosine
    cone = best_cone(observation.rays, free, (low, high), settings.tolerance, settings.tries)
    if cone is None:
        return _FreeCone(None, 0, free)
    left = left_free(observation.rays, free, cone, settings.tolerance)
    return _FreeCone(cone, int(np.count_nonzero(cone.members & free)), left)


def _judged(hypotheses: list[Hypothesis], row: FloatArray) -> tuple[HorizonStatus, str]:
    """Return the status of the search and the reason, from the hypotheses in descending order of quality.

    A refused horizon makes the best horizon ambiguous too if its edges are all above or all below those of
    the best horizon. If a part of the image is displaced, or from another exposure, each part has a horizon,
    of which the limb is missing in the other part. The argument `row` (n,) has the row of each edge.
    """
    best = hypotheses[0]
    flaw = _flaw(best)
    if flaw:
        return HorizonStatus.REFUSED, flaw
    count = np.count_nonzero(best.members)
    for other in hypotheses[1:]:
        apart = _angle(other.fit.view.nadir, best.fit.view.nadir)
        own = other.members & ~best.members
        if apart <= _SAME or np.count_nonzero(own) <= _RIVAL * count:
            continue
        if not _flaw(other):
            return HorizonStatus.AMBIGUOUS, f"two horizons {np.degrees(apart):.1f} deg apart"
        mine, others = row[best.members], row[own]
        if not _contradiction(other) and (mine.max() <= others.min() or others.max() <= mine.min()):
            torn = "a part of the image is displaced or from another exposure"
            return HorizonStatus.AMBIGUOUS, f"two horizons in different rows: {torn}"
    return HorizonStatus.FOUND, ""


def _angle(one: FloatArray, other: FloatArray) -> float:
    return float(np.arccos(np.clip(one @ other, -1.0, 1.0)))


def _is_limb(one: Hypothesis) -> bool:
    """Return whether a horizon is significant and its edges are about as wide as the atmosphere's profile."""
    return one.chance < _MOST_CHANCE and _BREADTH[0] < one.breadth < _BREADTH[1]


def _flaw(one: Hypothesis) -> str:
    """Return why a hypothesis is refused, or an empty string if it is accepted."""
    if contradiction := _contradiction(one):
        return contradiction
    light = one.lighting
    if light.stray > _STRAY:
        return f"{100.0 * light.stray:.0f} % of the sky and the night side are bright"
    if one.coverage < _COVERED:
        return f"only {100.0 * one.coverage:.0f} % of the sunlit limb in the image show an edge"
    if one.night > _NIGHT:
        return f"{100.0 * one.night:.0f} % of the horizon's points lie on the night side"
    return one.not_space


def _contradiction(one: Hypothesis) -> str:
    """Return how a hypothesis contradicts prior knowledge, or an empty string if it does not."""
    if one.guess.orientation.mismatch > MOST_MISMATCH:
        return f"the nadir contradicts a coarse direction by {one.guess.orientation.mismatch:.1f} sigma"
    if one.altitude_off > _MOST_ALTITUDE:
        implied = f"the limb implies an altitude of {1e-3 * one.implied_altitude:.0f} km"
        if one.guess.place.altitude_sigma >= UNKNOWN:
            return f"{implied}: if it is right, pass it explicitly"
        known = one.guess.place.surface.height_of(one.guess.place.position)
        return f"{implied}, not {1e-3 * known:.0f} km: correct the altitude or the field of view"
    return ""


def _measurement(
    fit: FittedLimb,
    covariance: FloatArray,
    place: Place | None,
    altitudes: tuple[float, float],
    residual: float,
) -> NadirMeasurement:
    """Return the nadir of a fitted limb; an unknown altitude is limited to the range `altitudes`, m.

    The argument `place` is the camera's position from prior knowledge, or None if the altitude is unknown.
    """
    view, used = fit.view, int(np.count_nonzero(fit.used))
    altitude, nadir = view.surface.height_of(view.position), view.nadir
    free = place is None or place.altitude_sigma >= UNKNOWN
    sigma = fit.altitude_sigma(SPHERE_ALTITUDE_SIGMA if free else 0.0)
    if free:
        mean, share = limited_normal(altitude, sigma, altitudes)
        # The error of the altitude is correlated with the error d (3,) of the view's rotation.
        # A rotation d of the view displaces nadir n by d x n.
        gain = np.cross(fit.covariance[:3, ALTITUDE] / sigma**2, nadir)
        nadir = nadir + (mean - altitude) * gain
        nadir = nadir / np.linalg.norm(nadir)
        covariance = covariance - (1.0 - share) * sigma**2 * np.outer(gain, gain)
        altitude, sigma = mean, math.sqrt(share) * sigma
    return NadirMeasurement(nadir, covariance, altitude, sigma, residual, used)


def limited_normal(mean: float, sigma: float, limits: tuple[float, float]) -> tuple[float, float]:
    """Return the mean of a truncated normal distribution, and its variance divided by `sigma`^2.

    The distribution with mean `mean` and standard deviation `sigma` is truncated at the two `limits`.
    """
    low, high = ((limit - mean) / sigma for limit in limits)
    x = np.linspace(max(low, min(-8.0, high - 1.0)), min(high, max(8.0, low + 1.0)), 2001)
    # The density is normalised to its maximum in the range, so that it does not underflow.
    nearest = min(max(0.0, low), high)
    weight = np.exp(0.5 * (nearest**2 - x**2))
    weight /= weight.sum()
    offset = float(weight @ x)
    return mean + sigma * offset, float(weight @ (x - offset) ** 2)


_IMPROBABLE = 1e-6
"""Probability below which the difference between the nadirs of two cameras is significant."""
_COMMON = 2.0
"""Assumed ratio of the variance of the difference of two nadirs to the sum of their variances.

The ratio is above 1, because an unknown limb height displaces two nadirs in opposite directions if they are
measured on opposite sides of the Earth.
"""
_OWN_AIR = 400.0
"""Standard deviation (m) of the difference between the limb heights in the images of two cameras."""


@dataclass(frozen=True, slots=True, eq=False)
class JointNadir:
    """The nadir from the images of several cameras at one instant.

    Attributes:
        status, reason: outcome of the search, and reason why no nadir was found.
        nadir: the measured nadir in body axes, or None unless the status is FOUND.
        cameras: indices of the cameras whose limb points were used in the fit.
        each: result of the search in each image, in camera axes, by the index of the camera.
        limb_height: fitted height of the limb above the ellipsoid, m, or NaN if no nadir was found.
    """

    status: HorizonStatus
    reason: str
    nadir: NadirMeasurement | None
    cameras: tuple[int, ...]
    each: Mapping[int, HorizonSolution]
    limb_height: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class _Vote:
    """A nadir (3,) in body axes and its covariance (3, 3), rad^2, measured from `edges` edges."""

    camera: int
    nadir: FloatArray
    covariance: FloatArray
    edges: int


def nadir_of_cameras(
    images: Mapping[int, Image],
    cameras: Sequence[MountedCamera],
    knowledge: HorizonKnowledge | None = None,
    settings: HorizonSettings | None = None,
    hidden: Mapping[int, BoolArray] | None = None,
) -> JointNadir:
    """Return the nadir in body axes from the images of several cameras.

    Args:
        images: images (rows, columns) taken at the same instant, by the index of the camera.
        cameras: all cameras of the body.
        knowledge: prior knowledge as for `find_nadir`, but in body axes instead of camera axes.
        settings: settings of the search, or None for the defaults.
        hidden: masks (rows, columns) of pixels that structure obstructs, by the index of the camera.

    Raises:
        ValueError: if an image or a mask does not have the size of its camera, or if pixels are not finite.
    """
    knowledge, settings = knowledge or HorizonKnowledge(), settings or HorizonSettings()

    scanned = {
        number: _ScannedImage(image, cameras[number].lens, (hidden or {}).get(number))
        for number, image in images.items()
    }

    def searched(number: int, known: HorizonKnowledge, is_last: bool = True) -> HorizonSolution:
        camera = cameras[number]
        rough = known.attitude
        if rough is not None:
            rough = RoughAttitude(multiply(camera.mounting, rough.quaternion), rough.sigma)
        sensed = tuple(replace(one, camera=camera.in_camera(one.camera)) for one in known.sensed)
        return _find(scanned[number], replace(known, attitude=rough, sensed=sensed), settings, is_last)

    each = {number: searched(number, knowledge, is_last=False) for number in images}
    votes = [vote for number, solution in each.items() for vote in _votes(number, solution, cameras[number])]
    group, rival = _agreed(votes)
    if rival or not group:
        # The reasons for refusals are determined only here, because they are needed only without a nadir.
        each = {n: found if found.nadir is not None else searched(n, knowledge) for n, found in each.items()}
        status, reason = (HorizonStatus.AMBIGUOUS, rival) if rival else _why_none(each)
        return JointNadir(status, reason, None, (), each)
    vote = max(group, key=lambda one: one.edges)
    view = each[vote.camera].view
    assert view is not None  # each vote comes from a camera with a fitted horizon
    position = knowledge.position if knowledge.position is not None else view.position
    sigma = float(np.sqrt(0.5 * np.trace(vote.covariance)))
    sensed = (*knowledge.sensed, SensedDirection(vote.nadir, -position, _COMMON * sigma))
    known = replace(knowledge, sensed=sensed)
    for number, first in list(each.items()):
        if first.nadir is None and len(first.points) >= settings.some_edges:
            second = searched(number, known)
            each[number] = replace(second, pixels_read=first.pixels_read + second.pixels_read)
    votes = [v for k, s in each.items() if s.nadir is not None for v in _votes(k, s, cameras[k])]
    group, rival = _agreed(votes)
    if rival or not group:
        reason = rival or "the cameras' horizons do not agree"
        return JointNadir(HorizonStatus.AMBIGUOUS, reason, None, (), each)
    return _joint_fit(tuple(vote.camera for vote in group), cameras, each, knowledge, settings)


def _votes(number: int, solution: HorizonSolution, camera: MountedCamera) -> list[_Vote]:
    """Return the nadir found in an image as a vote, or all candidates as votes if the image is ambiguous."""
    if solution.nadir is not None:
        left: tuple[NadirMeasurement, ...] = (solution.nadir,)
    else:
        left = solution.candidates if solution.status is HorizonStatus.AMBIGUOUS else ()
    turn = camera.to_camera
    return [_Vote(number, turn.T @ one.direction, turn.T @ one.covariance @ turn, one.used) for one in left]


def _agreed(votes: Sequence[_Vote]) -> tuple[list[_Vote], str]:
    """Return the votes for the nadir on which most cameras agree, or an empty list and the reason.

    If two nadirs are supported by the same number of cameras, the nadir with more edges is selected. Two
    candidates of the same camera never count as agreeing.
    """
    groups = []
    for first in votes:
        agreeing = [v for v in votes if v.camera != first.camera and _same(first, v)]
        nearest = {v.camera: v for v in sorted(agreeing, key=lambda v: float(v.nadir @ first.nadir))}
        groups.append([first, *nearest.values()])
    groups.sort(key=lambda group: (len(group), sum(v.edges for v in group)), reverse=True)
    if not groups:
        return [], ""
    best = groups[0]
    count = sum(v.edges for v in best)
    for other in groups[1:]:
        if any(v is w for v in other for w in best) or any(_same(v, w) for v in other for w in best):
            continue
        # A second nadir makes the result ambiguous only if as many cameras agree on it as on the first.
        if len(other) == len(best) and sum(v.edges for v in other) > _RIVAL * count:
            apart = np.degrees(_angle(other[0].nadir, best[0].nadir))
            return [], f"the cameras show two horizons {apart:.1f} deg apart"
    return best, ""


def _same(one: _Vote, other: _Vote) -> bool:
    """Return whether the nadirs of two votes agree within their covariances."""
    if float(one.nadir @ other.nadir) < 0.0:
        return False
    across = tangent_basis(one.nadir)
    off = across @ other.nadir
    spread = _COMMON * across @ (one.covariance + other.covariance) @ across.T
    return float(off @ np.linalg.solve(spread, off)) < chi_square.bound(_IMPROBABLE, 2)


def _why_none(each: Mapping[int, HorizonSolution]) -> tuple[HorizonStatus, str]:
    """Return the most favourable status of the searches in all images, and the reason for it."""
    for status in (HorizonStatus.AMBIGUOUS, HorizonStatus.REFUSED, HorizonStatus.NO_HORIZON):
        for number, solution in each.items():
            if solution.status is status:
                return status, f"camera {number}: {solution.reason}"
    return HorizonStatus.NO_HORIZON, "no image"


def _joint_fit(
    numbers: tuple[int, ...],
    cameras: Sequence[MountedCamera],
    each: Mapping[int, HorizonSolution],
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
) -> JointNadir:
    """Return the nadir of one limb fitted to the limb points of all agreeing cameras."""
    most = max(numbers, key=lambda number: len(each[number].limb))
    view, camera = each[most].view, cameras[most]
    assert view is not None  # each camera in `numbers` has found a horizon
    place = place_of(knowledge, settings)
    located = place is not None and place.located
    body = replace(view, rotation=camera.to_camera.T @ view.rotation, limb_height=UNIT_DEPTH_HEIGHT)
    down = -body.position / np.linalg.norm(body.position)
    stand = orientation(body.nadir, down, knowledge if located else HorizonKnowledge())
    rays = np.concatenate([cameras[number].in_body(each[number].limb) for number in numbers])
    sigma = np.concatenate([each[number].limb_sigma for number in numbers])
    altitude = UNKNOWN if place is None else place.altitude_sigma
    prior = prior_of(settings, stand.sigma, altitude)
    fit = fit_limb(body, rays, sigma, prior)
    if fit is None:
        return JointNadir(HorizonStatus.REFUSED, "no limb fits the edges of all cameras", None, (), each)
    groups = np.repeat(np.arange(len(numbers)), [len(each[number].limb) for number in numbers])
    own = np.full(len(numbers), _OWN_AIR / fit.view.limb_distance)
    shared = shared_error(fit, rays, sigma, prior, groups, own)
    fit = replace(fit, covariance=fit.covariance + shared)
    nadir = fit.view.nadir
    allowance = limb_tilt_sigma(fit.view, stand, settings)
    covariance = fit.nadir_covariance + allowance**2 * (np.eye(3) - np.outer(nadir, nadir))
    pixel = 1.0 / camera.lens.focal_length
    residual = float(np.sqrt(np.mean(fit.residuals[fit.used] ** 2))) / pixel
    measured = _measurement(fit, covariance, place, settings.altitudes, residual)
    return JointNadir(HorizonStatus.FOUND, "", measured, numbers, each, fit.view.limb_height)
