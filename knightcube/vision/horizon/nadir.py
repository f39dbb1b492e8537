"""Nadir from a picture: the default method.

    solution = find_nadir(frame, camera, HorizonKnowledge(position=..., sun=..., attitude=...))
    if solution.nadir is not None:
        filter.update(solution.nadir.direction, solution.nadir.covariance, -position)

Finds edges on scan lines and cones on which many of them agree, fits the ellipsoid's limb to each, and tests
each fit against chance, the air's breadth, the light of the whole picture, the coarse sensors and the rough
attitude. A single consistent fit is the result; several are ambiguous; without one the picture is refused
with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.astro.directions import tangent_basis
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.camera.pixel_access import ArrayPixels, PixelAccess
from knightcube.vision.horizon.edges import Nearby, Observation, find_edges, observe
from knightcube.vision.horizon.hypothesis import Hypothesis, examine, near_limb
from knightcube.vision.horizon.initial_guess import (
    MOST_MISMATCH,
    SPHERE_ALTITUDE_SIGMA,
    InitialGuess,
    Place,
    best_cone,
    cosine_at,
    initial_guess,
    left_free,
    place_of,
)
from knightcube.vision.horizon.limb_fit import View
from knightcube.vision.horizon.settings import HorizonKnowledge, HorizonSettings


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


_WIDER = 2.0
"""Factor by which the search for cones exceeds the range of an unknown altitude: three edges are
inaccurate."""
_MOST_ALTITUDE = 3.0
"""Largest excess of the fitted altitude over that range, in standard deviations."""
_STRAY, _COVERED, _NIGHT = 0.05, 0.6, 0.1
_RIVAL = 0.3
"""Share of the best horizon's edges with which a second horizon, with edges of its own, is a rival."""
_SAME = np.radians(1.0)
_MOST_CHANCE = -6.0
"""Largest log10 of the number of cones that chance edges would fit as well."""
_BREADTH = 0.125, 2.0
"""Least and largest ratio of the breadth of an edge of the limb to that of the air."""
_GAIN = 1.5
"""Least ratio of the edges on a horizon with three times the lines: fewer reject the horizon."""


def find_nadir(
    frame: Image | PixelAccess,
    camera: CameraModel,
    knowledge: HorizonKnowledge | None = None,
    settings: HorizonSettings | None = None,
) -> HorizonSolution:
    """Return the nadir that the horizon in a frame gives, or why there is none.

    Near a horizon of few edges more lines are read; edges without a horizon are searched again on more lines
    everywhere. Raises ValueError for a frame of another size than the camera's, or with
    pixels that are not finite.
    """
    knowledge, settings = knowledge or HorizonKnowledge(), settings or HorizonSettings()
    access = ArrayPixels(frame) if isinstance(frame, np.ndarray) else frame
    if (access.columns, access.rows) != (camera.columns, camera.rows):
        raise ValueError(
            f"a frame of {access.columns} x {access.rows} pixels, but the camera has"
            f" {camera.columns} x {camera.rows}"
        )
    look = _look(access, camera, knowledge, settings)
    found = look.solution()
    if found.nadir is not None and found.nadir.used >= settings.enough_edges:
        return found
    if len(found.points) < settings.some_edges:
        return found
    again = replace(settings, edges=replace(settings.edges, lines=settings.edges.more_lines))
    read = found.pixels_read
    if found.nadir is not None:
        closer = _closer(look, access, camera, knowledge, again)
        read += closer.read
        second = closer.solution()
        if second.nadir is not None and second.nadir.used >= _GAIN * found.nadir.used:
            # The first look has already compared it with its rivals.
            return replace(second, candidates=found.candidates, pixels_read=read)
    second = _look(access, camera, knowledge, again).solution()
    return replace(second, pixels_read=read + second.pixels_read)


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """One search: `levels` as in `ScanLines`, hypotheses, the best first; number of pixels read."""

    observation: Observation
    levels: tuple[float, float, float]
    hypotheses: list[Hypothesis]
    read: int

    def solution(self) -> HorizonSolution:
        """Return the result of this search."""
        points, hypotheses = self.observation.edges.points, self.hypotheses
        if not hypotheses:
            return HorizonSolution(
                HorizonStatus.NO_HORIZON,
                f"{len(points)} edges lie on no horizon better than chance edges would",
                points=points,
                on_horizon=np.zeros(len(points), dtype=bool),
                pixels_read=self.read,
            )
        status, reason = _judged(hypotheses)
        best, found = hypotheses[0], status is HorizonStatus.FOUND
        return HorizonSolution(
            status,
            reason,
            _measurement(best) if found else None,
            tuple(_measurement(each) for each in (hypotheses[1:] if found else hypotheses)),
            points,
            best.members,
            best.limb.rays,
            best.limb.sigma,
            best.fit.view,
            self.read,
        )


def _look(
    access: PixelAccess, camera: CameraModel, knowledge: HorizonKnowledge, settings: HorizonSettings
) -> _Look:
    edges, lines = find_edges(access, settings.edges)
    observation = observe(edges, lines, camera)
    hypotheses = _hypotheses(observation, place_of(knowledge, settings), knowledge, settings, camera)
    return _Look(observation, lines.levels, hypotheses, lines.pixels)


def _closer(
    look: _Look,
    access: PixelAccess,
    camera: CameraModel,
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
) -> _Look:
    """Return the best horizon of a look again, with more lines across it."""
    best = look.hypotheses[0]
    points = look.observation.edges.points[best.members]
    box = np.stack([points.min(axis=0) - look.observation.space, points.max(axis=0) + look.observation.space])
    edges, lines = find_edges(access, settings.edges, Nearby(box, look.levels))
    # The first look's samples have already tested the whole picture's light.
    observation = observe(edges, lines, camera, look.observation.samples)
    members = near_limb(best.fit.view, observation, 2.0 * settings.tolerance)
    again = replace(best.guess, view=best.fit.view, members=members)
    found = examine(again, observation, knowledge, settings, camera)
    return _Look(
        observation, look.levels, [] if found is None or not _is_limb(found) else [found], lines.pixels
    )


def _hypotheses(
    observation: Observation,
    place: Place | None,
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
    camera: CameraModel,
) -> list[Hypothesis]:
    """Return the possible horizons, those without a flaw first, then by their edges."""
    if place is None:
        least, most = settings.altitudes
        low, high = (cosine_at(altitude) for altitude in (least / _WIDER, most * _WIDER))
    else:
        low = high = place.cosine
    free = np.ones(len(observation.edges), dtype=bool)
    sound: list[Hypothesis] = []
    contradicted: list[InitialGuess] = []
    # Cones too small to rival an accepted horizon are skipped.
    enough = float(settings.least_edges)
    for _ in range(settings.candidates):
        if np.count_nonzero(free) < enough:
            break
        cone = best_cone(observation.rays, free, (low, high), settings.tolerance, settings.tries)
        if cone is None or np.count_nonzero(cone.members & free) < enough:
            break
        free = left_free(observation.rays, free, cone, settings.tolerance)
        guess = initial_guess(cone, observation, place, knowledge, settings)
        if guess.orientation.mismatch > MOST_MISMATCH:
            contradicted.append(guess)
            continue
        found = examine(guess, observation, knowledge, settings, camera)
        if found is not None and _is_limb(found):
            sound.append(found)
            if not _flaw(found):
                enough = max(enough, _RIVAL * np.count_nonzero(found.members))
    if all(_flaw(each) for each in sound):
        # Contradicted guesses are fitted only for the reason of the refusal.
        fitted = (examine(each, observation, knowledge, settings, camera) for each in contradicted)
        sound += [each for each in fitted if each is not None and _is_limb(each)]
    return sorted(sound, key=lambda each: (_flaw(each) != "", -np.count_nonzero(each.members)))


def _judged(hypotheses: list[Hypothesis]) -> tuple[HorizonStatus, str]:
    """Return status and reason for hypotheses, the best first."""
    best = hypotheses[0]
    flaw = _flaw(best)
    if flaw:
        return HorizonStatus.REFUSED, flaw
    count = np.count_nonzero(best.members)
    for other in hypotheses[1:]:
        apart = float(np.arccos(np.clip(other.fit.view.nadir @ best.fit.view.nadir, -1.0, 1.0)))
        own = np.count_nonzero(other.members & ~best.members)
        if not _flaw(other) and apart > _SAME and own > _RIVAL * count:
            return HorizonStatus.AMBIGUOUS, f"two horizons {np.degrees(apart):.1f} deg apart"
    return HorizonStatus.FOUND, ""


def _is_limb(one: Hypothesis) -> bool:
    """Return whether chance edges do not explain a hypothesis, and its edges are as broad as the air."""
    return one.chance < _MOST_CHANCE and _BREADTH[0] < one.breadth < _BREADTH[1]


def _flaw(one: Hypothesis) -> str:
    """Return the reason against a hypothesis; empty without one."""
    light = one.lighting
    if one.guess.orientation.mismatch > MOST_MISMATCH:
        return f"a coarse direction is {one.guess.orientation.mismatch:.1f} sigma off"
    if one.altitude_off > _MOST_ALTITUDE:
        altitude = one.fit.view.surface.height_of(one.fit.view.position)
        return f"a limb of that size is seen from {1e-3 * altitude:.0f} km: give the altitude if so"
    if light.stray > _STRAY:
        return f"{100.0 * light.stray:.0f} % of sky and night are bright"
    if one.coverage < _COVERED:
        return f"only {100.0 * one.coverage:.0f} % of the lit limb in view show an edge"
    if one.night > _NIGHT:
        return f"{100.0 * one.night:.0f} % of the horizon's points lie in the night"
    return ""


def _measurement(one: Hypothesis) -> NadirMeasurement:
    view = one.fit.view
    allowance = 0.0 if one.guess.place.located else SPHERE_ALTITUDE_SIGMA
    return NadirMeasurement(
        view.nadir,
        one.covariance,
        view.surface.height_of(view.position),
        one.fit.altitude_sigma(allowance),
        one.residual,
        int(np.count_nonzero(one.members)),
    )
