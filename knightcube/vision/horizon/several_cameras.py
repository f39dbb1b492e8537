"""Nadir from the pictures of several cameras at once (Meller et al., chapter 4: three or four of them).

    found = nadir_of_cameras({0: frame, 2: other}, cameras, HorizonKnowledge(position=..., sun=...))

Each picture is searched alone. What different cameras found must be one nadir; a picture that gave none, or
several, is searched again with the others' nadir known. One limb is then fitted to the points of all: what
shifts every limb outwards, the air's unknown height, shifts nadir only where a single side is seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.directions import tangent_basis
from knightcube.astro.quaternion import multiply
from knightcube.vision.camera.lens import MountedCamera
from knightcube.vision.camera.pixel_access import PixelAccess
from knightcube.vision.horizon.initial_guess import SPHERE_ALTITUDE_SIGMA, orientation, place_of
from knightcube.vision.horizon.limb_fit import UNKNOWN, FittedLimb, Prior, View, fit_limb, shared_error
from knightcube.vision.horizon.limb_profile import UNIT_DEPTH_HEIGHT
from knightcube.vision.horizon.nadir import HorizonSolution, HorizonStatus, NadirMeasurement, find_nadir
from knightcube.vision.horizon.settings import (
    HorizonKnowledge,
    HorizonSettings,
    RoughAttitude,
    SensedDirection,
)

_IMPROBABLE = 1e-6
"""Probability below which the nadirs of two cameras differ significantly."""
_COMMON = 2.0
"""Largest ratio of a difference's variance to the sum of both: unknown air shifts opposite limbs apart."""
_RIVAL = 0.3
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
        if len(other) == len(best) and sum(v.edges for v in other) > _RIVAL * count:
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
    measured = _measurement(fit, cameras[most], allowance, 0.0 if located else SPHERE_ALTITUDE_SIGMA)
    return JointNadir(HorizonStatus.FOUND, "", measured, numbers, each, fit.view.limb_height)


def _reach(view: View) -> float:
    """Return how far off the limb is, m."""
    return float(np.sqrt(max(float(view.position @ view.position) - view.surface.equatorial**2, 1.0)))


def _measurement(
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
