"""Nadir from a picture: the default method.

    solution = find_nadir(frame, camera, HorizonKnowledge(position=..., sun=..., attitude=...))
    if solution.nadir is not None:
        filter.update(solution.nadir.direction, solution.nadir.covariance, -position)

Finds edges on scan lines and cones on which many of them agree, fits the ellipsoid's limb to each, and tests
each fit against chance, the air's breadth, the light of the whole picture, the coarse sensors and the rough
attitude. A single consistent fit is the result; several are ambiguous; without one the picture is refused
with the reason.

Nadir from the pictures of several cameras at once (Meller et al., chapter 4: three or four of them).

    found = nadir_of_cameras({0: frame, 2: other}, cameras, HorizonKnowledge(position=..., sun=...))

Each picture is searched alone. What different cameras found must be one nadir; a picture that gave none, or
several, is searched again with the others' nadir known. One limb is then fitted to the points of all: what
shifts every limb outwards, the air's unknown height, shifts nadir only where a single side is seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.astro.directions import tangent_basis
from knightcube.astro.quaternion import multiply
from knightcube.vision.camera.lens import CameraModel, MountedCamera
from knightcube.vision.frame import ArrayPixels, PixelAccess
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
    orientation,
    place_of,
)
from knightcube.vision.horizon.limb import (
    UNIT_DEPTH_HEIGHT,
    UNKNOWN,
    FittedLimb,
    LimbView,
    Prior,
    fit_limb,
    shared_error,
)
from knightcube.vision.horizon.settings import (
    HorizonKnowledge,
    HorizonSettings,
    RoughAttitude,
    SensedDirection,
)


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
    view: LimbView | None = None
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


_IMPROBABLE = 1e-6
"""Probability below which the nadirs of two cameras differ significantly."""
_COMMON = 2.0
"""Largest ratio of a difference's variance to the sum of both: unknown air shifts opposite limbs apart."""
_RIVAL_CAMERAS = 0.3
"""Share of the edges with which as many disagreeing cameras make the nadir ambiguous."""
_UNKNOWN_TURN = 1.0
"""Prior standard deviation of an unknown rotation about nadir (rad)."""
_OWN_AIR = 400.0
"""Standard deviation (m) of a limb's height in one image relative to another: light and background differ."""


@dataclass(frozen=True, slots=True, eq=False)
class JointNadir:
    """The outcome of one instant's pictures.

    Attributes:
        nadir: the measurement in body axes, when the status is FOUND.
        cameras: the numbers of the cameras whose limb it rests on.
        each: what each camera's picture gave, in its own axes.
        limb_height: m above the ellipsoid, as fitted; NaN without a measurement.
    """

    status: HorizonStatus
    reason: str
    nadir: NadirMeasurement | None
    cameras: tuple[int, ...]
    each: Mapping[int, HorizonSolution]
    limb_height: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class _Vote:
    """One horizon that a camera proposes: nadir (3,) and covariance (3, 3), body axes; its edges."""

    camera: int
    nadir: FloatArray
    covariance: FloatArray
    edges: int


def nadir_of_cameras(
    frames: Mapping[int, Image | PixelAccess],
    cameras: Sequence[MountedCamera],
    knowledge: HorizonKnowledge | None = None,
    settings: HorizonSettings | None = None,
) -> JointNadir:
    """Return the nadir in body axes that the frames of some of the cameras, by number, give together.

    The frames are of one instant, and the axes of `knowledge` are the body's where those of a single picture
    are the camera's. Raises ValueError like `find_nadir`.
    """
    knowledge, settings = knowledge or HorizonKnowledge(), settings or HorizonSettings()
    each = {
        number: find_nadir(frame, cameras[number].lens, _for(cameras[number], knowledge), settings)
        for number, frame in frames.items()
    }
    votes = [vote for number, solution in each.items() for vote in _votes(number, solution, cameras[number])]
    group, rival = _agreed(votes)
    if rival:
        return JointNadir(HorizonStatus.AMBIGUOUS, rival, None, (), each)
    if not group:
        return JointNadir(*_why_none(each), None, (), each)
    known = _with_nadir(knowledge, group, cameras, each)
    for number, frame in frames.items():
        if each[number].nadir is None and known is not None and _may_answer(each[number], settings):
            camera = cameras[number]
            second = find_nadir(frame, camera.lens, _for(camera, known), settings)
            read = each[number].pixels_read + second.pixels_read
            each[number] = replace(second, pixels_read=read)
    votes = [v for k, s in each.items() if s.nadir is not None for v in _votes(k, s, cameras[k])]
    group, rival = _agreed(votes)
    if rival or not group:
        reason = rival or "the cameras' horizons do not agree"
        return JointNadir(HorizonStatus.AMBIGUOUS, reason, None, (), each)
    return _joined(tuple(vote.camera for vote in group), cameras, each, knowledge, settings)


def _for(camera: MountedCamera, knowledge: HorizonKnowledge) -> HorizonKnowledge:
    """Return what is known in body axes in those of a camera."""
    rough = knowledge.attitude
    return replace(
        knowledge,
        attitude=None
        if rough is None
        else RoughAttitude(multiply(camera.mounting, rough.quaternion), rough.sigma),
        sensed=tuple(replace(one, camera=camera.in_camera(one.camera)) for one in knowledge.sensed),
    )


def _votes(number: int, solution: HorizonSolution, camera: MountedCamera) -> list[_Vote]:
    """Return the horizons that a picture leaves: the one found, or those between which it cannot choose."""
    if solution.nadir is not None:
        left: tuple[NadirMeasurement, ...] = (solution.nadir,)
    else:
        left = solution.candidates if solution.status is HorizonStatus.AMBIGUOUS else ()
    turn = camera.to_camera
    return [_Vote(number, turn.T @ one.direction, turn.T @ one.covariance @ turn, one.used) for one in left]


def _agreed(votes: Sequence[_Vote]) -> tuple[list[_Vote], str]:
    """Return the votes for one nadir that have the most cameras and edges, and a rival nadir if there is one.

    The candidates of a single camera agree with none but those of other cameras.
    """
    groups = []
    for first in votes:
        alike = [v for v in votes if v.camera != first.camera and _same(first, v)]
        nearest = {v.camera: v for v in sorted(alike, key=lambda v: float(v.nadir @ first.nadir))}
        groups.append([first, *nearest.values()])
    groups.sort(key=lambda group: (len(group), sum(v.edges for v in group)), reverse=True)
    if not groups:
        return [], ""
    best = groups[0]
    count = sum(v.edges for v in best)
    for other in groups[1:]:
        apart = float(np.arccos(np.clip(other[0].nadir @ best[0].nadir, -1.0, 1.0)))
        if any(v is w for v in other for w in best) or any(_same(v, w) for v in other for w in best):
            continue
        # Cameras that agree outvote fewer; the other candidates of one that agrees are fewer, too.
        if len(other) == len(best) and sum(v.edges for v in other) > _RIVAL_CAMERAS * count:
            return [], f"the cameras show two horizons {np.degrees(apart):.1f} deg apart"
    return best, ""


def _same(one: _Vote, other: _Vote) -> bool:
    if float(one.nadir @ other.nadir) < 0.0:
        return False
    across = tangent_basis(one.nadir)
    off = across @ other.nadir
    spread = _COMMON * across @ (one.covariance + other.covariance) @ across.T
    return float(off @ np.linalg.solve(spread, off)) < chi_square.bound(_IMPROBABLE, 2)


def _why_none(each: Mapping[int, HorizonSolution]) -> tuple[HorizonStatus, str]:
    """Return status and reason of the picture that came nearest to a horizon."""
    order = (HorizonStatus.AMBIGUOUS, HorizonStatus.REFUSED, HorizonStatus.NO_HORIZON)
    for status in order:
        for number, solution in each.items():
            if solution.status is status:
                return status, f"camera {number}: {solution.reason}"
    return HorizonStatus.NO_HORIZON, "no picture"


def _may_answer(solution: HorizonSolution, settings: HorizonSettings) -> bool:
    return len(solution.points) >= settings.some_edges


def _with_nadir(
    knowledge: HorizonKnowledge,
    group: Sequence[_Vote],
    cameras: Sequence[MountedCamera],
    each: Mapping[int, HorizonSolution],
) -> HorizonKnowledge | None:
    """Return the knowledge with the nadir that a group of votes agrees on; None where no place is known."""
    vote = max(group, key=lambda one: one.edges)
    view = each[vote.camera].view
    if view is None:
        return None
    position = knowledge.position if knowledge.position is not None else view.position
    sigma = float(np.sqrt(0.5 * np.trace(vote.covariance)))
    return replace(
        knowledge, sensed=(*knowledge.sensed, SensedDirection(vote.nadir, -position, _COMMON * sigma))
    )


def _joined(
    numbers: tuple[int, ...],
    cameras: Sequence[MountedCamera],
    each: Mapping[int, HorizonSolution],
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
) -> JointNadir:
    """Return one limb fitted to the points of all the cameras that agree."""
    most = max(numbers, key=lambda number: len(each[number].limb))
    view, camera = each[most].view, cameras[most]
    assert view is not None
    place = place_of(knowledge, settings)
    located = place is not None and place.located
    body = replace(view, rotation=camera.to_camera.T @ view.rotation, limb_height=UNIT_DEPTH_HEIGHT)
    down = -body.position / np.linalg.norm(body.position)
    stand = orientation(body.nadir, down, knowledge if located else HorizonKnowledge())
    rays = np.concatenate([cameras[number].in_body(each[number].limb) for number in numbers])
    sigma = np.concatenate([each[number].limb_sigma for number in numbers])
    altitude = UNKNOWN if place is None else place.altitude_sigma
    prior = Prior(min(stand.sigma, _UNKNOWN_TURN), settings.limb_height_sigma, altitude)
    fit = fit_limb(body, rays, sigma, prior)
    if fit is None:
        return JointNadir(HorizonStatus.REFUSED, "no limb fits all the cameras", None, (), each)
    allowance = settings.sphere_sigma if np.isinf(stand.sigma) else 0.0
    groups = np.repeat(np.arange(len(numbers)), [len(each[number].limb) for number in numbers])
    own = np.full(len(numbers), _OWN_AIR / _reach(fit.view))
    covariance = fit.covariance + shared_error(fit, rays, sigma, prior, groups, own)
    fit = replace(fit, covariance=covariance)
    measured = _joint_measurement(fit, cameras[most], allowance, 0.0 if located else SPHERE_ALTITUDE_SIGMA)
    return JointNadir(HorizonStatus.FOUND, "", measured, numbers, each, fit.view.limb_height)


def _reach(view: LimbView) -> float:
    """Return how far off the limb is, m."""
    return float(np.sqrt(max(float(view.position @ view.position) - view.surface.equatorial**2, 1.0)))


def _joint_measurement(
    fit: FittedLimb, camera: MountedCamera, allowance: float, altitude: float
) -> NadirMeasurement:
    nadir = fit.view.nadir
    across = np.eye(3) - np.outer(nadir, nadir)
    pixel = 1.0 / camera.lens.focal_length
    return NadirMeasurement(
        nadir,
        fit.nadir_covariance + allowance**2 * across,
        fit.view.surface.height_of(fit.view.position),
        fit.altitude_sigma(altitude),
        float(np.sqrt(np.mean(fit.residuals[fit.used] ** 2))) / pixel,
        int(np.count_nonzero(fit.used)),
    )
