"""The joint fit: the brightest stars, and all that share their pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import BoolArray, IntArray
from knightcube.vision.streaks.maximum_likelihood.agreement import OwnEstimates, agreeing, own_estimates
from knightcube.vision.streaks.maximum_likelihood.chains import close_by
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import Float32Array
from knightcube.vision.streaks.maximum_likelihood.iteration import (
    GROWING,
    LAST,
    ROUGH,
    ExposedCamera,
    Fit,
    iterate,
)
from knightcube.vision.streaks.maximum_likelihood.length_correction import stretched
from knightcube.vision.streaks.maximum_likelihood.matched_filter import FaintStars, find_faint
from knightcube.vision.streaks.maximum_likelihood.motion import Motion
from knightcube.vision.streaks.maximum_likelihood.normal_equations import light_of
from knightcube.vision.streaks.maximum_likelihood.scene import Scene, mid_exposure, path_lengths
from knightcube.vision.streaks.maximum_likelihood.windows import window_areas

# A rate that changes by more than this part of itself is beyond the model: 2 is from rest, or to it.
_MOST_GROWTH = 2.2
# A star is trusted within this many deviations; ends (px) and width (px) are never modelled better than this.
_TRUST_SIGMAS = 3.5
_END_FLOOR = 0.01
_WIDTH_FLOOR = 0.002
# Streaks this many reaches beside a bright one's are fitted with it: farther ones touch only its window's
# edge.
_NEAR = 1.4
# Ends that move by more px than this from the first fit to the last make the stars to be found again.
_FAR = 6.0
_MOST_REPEATS = 2
# How wrong the light of a faint star found along the motion may be on a pixel, as part of it.
_DOUBT = 0.35
# Pixels of all windows that a fit looks at, those that stars share once for each: what a crowd of long
# streaks needs of memory and time is bounded so, and the brightest stars hold most of the information.
_MOST_PIXELS = 60_000
# Streaks that are fitted anew with all on their pixels take this part of that, but are so many at least.
_BARED_SHARE = 0.5
_LEAST_BARED = 10
# Stars that share a bright one's pixels are sought down to this significance: what they hide moves its ends.
_HIDDEN_SIGMAS = 4.5
# This many stars' light is taken out at a time.
_AT_ONCE = 16


def last_fit(camera: ExposedCamera, first: Fit) -> tuple[Fit | None, FaintStars]:
    """Return the joint fit of the brightest stars, and the faint ones that it left to the matched filter.

    Where it comes far from `first`, the stars found along that motion are not where they seemed: once more.
    Likewise from where the streaks really end, where the fit has other ends. A fit that they contradict again
    is dropped.
    """
    other = None
    for _ in range(_MOST_REPEATS):
        done, faint = _fit_from(camera, first)
        if done is None:
            break
        leading = np.flatnonzero(done.scene.trusted)
        scene = done.scene.select(leading)
        other = stretched(camera, scene)
        if other is None and not _far(camera, first.scene, scene):
            break
        if camera.work.exhausted:
            return None, faint
        scene = scene if other is None else other
        scene = scene.select(np.argsort(-scene.light, kind="stable")[: len(first.scene.light)])
        first = replace(done, scene=scene, windows=camera.windows(scene))
    else:
        done = done if other is None else None
    return done, faint


def _far(camera: ExposedCamera, before: Scene, after: Scene) -> bool:
    """Return whether the ends of the streaks have moved by more than the fit can follow."""
    changed = float(np.linalg.norm(after.motion.whole - before.motion.whole))
    turn = float(np.linalg.norm(after.motion.whole))
    length = float(np.median(path_lengths(camera.pinhole, after.motion, before.stars)))
    return length * changed / max(turn, 1e-12) > _FAR


def _fit_from(camera: ExposedCamera, first: Fit) -> tuple[Fit | None, FaintStars]:
    """Return the joint fit of the stars that are found along the motion of `first`, and the faint ones left.

    Of the models of the rate the fit takes the constant one unless the settings or the pixels demand the
    other.
    """
    settings, before = camera.settings, first.scene
    if not before.motion.constant:
        camera = replace(camera, growing=True)
    faint = _found_along(camera, first)
    whole = before.with_stars(faint.stars, faint.light)
    order = np.argsort(-whole.light, kind="stable")
    bright, rest = order[: settings.most_stars], order[settings.most_stars :]
    scene, others = whole.select(bright), whole.select(rest)
    scene = replace(scene, trusted=np.ones(len(bright), dtype=np.bool_))
    near = np.flatnonzero(
        close_by(
            camera.pinhole, scene.motion, others.stars, scene.stars, _NEAR * settings.reach * scene.width
        )
    )
    fitted = others.select(near[: settings.most_neighbours])
    scene = scene.with_stars(fitted.stars, fitted.light)
    beyond = others.select(near[settings.most_neighbours :])
    done = joint_fit(_accounted(camera, beyond), scene)
    if done is not None and done.hidden is not None:
        done = replace(done, hidden=done.hidden.with_stars(beyond.stars, beyond.light))
    rest = np.delete(rest, near[: settings.most_neighbours])
    rest = rest[rest >= len(before.light)] - len(before.light)
    rest = rest[faint.significance[rest] >= settings.faint_sigmas]
    return done, FaintStars(faint.stars[rest], faint.light[rest], faint.significance[rest])


def _found_along(camera: ExposedCamera, first: Fit) -> FaintStars:
    """Return the streaks along the motion of `first`, less its own, by their places at mid-exposure."""
    settings, motion = camera.settings, first.scene.motion
    camera.work.passed(camera.frame.signal.size)
    light = light_of(camera.pinhole, camera.shutter, first.scene, first.windows)
    faint = find_faint(
        camera.frame,
        (first.windows.pixels, light),
        camera.pinhole,
        motion,
        min(_HIDDEN_SIGMAS, settings.faint_sigmas),
        settings.most_faint,
    )
    return replace(faint, stars=mid_exposure(camera.pinhole, motion, camera.shutter, faint.stars))


def joint_fit(camera: ExposedCamera, scene: Scene, room: float = 1.0) -> Fit | None:
    """Return the fit of `scene` by the stars that agree, under the rate's model that the pixels ask for.

    Of the untrusted stars the brightest are fitted, as far as there is room, `room` times as much as usual;
    the others' light is taken out as it is known. None where the fit fails.
    """
    fitted = _affordable(camera, scene, room)
    hidden = scene.select(~fitted)
    camera, scene = _accounted(camera, hidden), scene.select(fitted)
    done = iterate(camera, scene, camera.free, ROUGH)
    if done is not None and camera.undecided and done.grows():
        camera = replace(camera, growing=True)
        done = iterate(camera, done.scene, camera.free, LAST, done.windows)
    if done is None or _beyond(done.scene.motion):
        return None
    scene, windows = replace(done.scene, trusted=_trusted(camera, done)), [done.windows]
    del done  # equations of tens of MB; the windows too are let go where new ones are cut
    done = iterate(camera, scene, camera.free, LAST, windows.pop())
    if done is not None and camera.undecided and done.grows():
        done = iterate(replace(camera, growing=True), done.scene, GROWING, LAST, done.windows)
    return None if done is None or _beyond(done.scene.motion) else replace(done, hidden=hidden)


def refit(camera: ExposedCamera, last: Fit) -> Fit | None:
    """Return the joint fit again, from the result `last` on, with all its brightest stars trusted.

    `camera` differs from that of `last` in how it draws paths.
    """
    scene = last.scene
    leading = np.arange(len(scene.light)) < max(camera.settings.most_stars, 1)
    scene = replace(scene, trusted=scene.trusted | leading)
    hidden = last.hidden
    return joint_fit(camera, scene if hidden is None else scene.with_stars(hidden.stars, hidden.light))


def bared_fit(camera: ExposedCamera, last: Fit) -> Fit | None:
    """Return a fit of the brightest streaks of `last` and all that lies on their pixels.

    Stars that are hidden in a streak move its ends: where the joint fit had no room for them, fewer streaks
    with all of those know the motion better. None where it had room, and where the fit fails or goes astray.
    """
    others, scene = last.hidden, last.scene
    if others is None or not len(others.light):
        return None
    camera = replace(camera, growing=bool(last.free[3]))
    order = np.argsort(-scene.light * scene.trusted, kind="stable")[: np.count_nonzero(scene.trusted)]
    areas = np.cumsum(window_areas(camera.pinhole, scene.select(order), camera.settings.reach))
    leading = order[: max(_LEAST_BARED, int(np.count_nonzero(areas < _BARED_SHARE * _MOST_PIXELS)))]
    first, rest = scene.select(leading), scene.select(np.setdiff1d(np.arange(len(scene.light)), leading))
    stars, light = (np.concatenate(both) for both in ((rest.stars, others.stars), (rest.light, others.light)))
    distance = _NEAR * camera.settings.reach * scene.width
    near = close_by(camera.pinhole, scene.motion, stars, first.stars, distance)
    whole = first.with_stars(stars[near], light[near])
    fitted = _affordable(camera, whole, 1.0)
    camera = _accounted(camera, whole.select(~fitted))
    done = iterate(camera, whole.select(fitted), last.free, LAST)
    lost = done is None or _beyond(done.scene.motion) or _far(camera, scene, done.scene)
    return None if lost else done


def _beyond(motion: Motion) -> bool:
    """Return whether the rate changes by more than the model can describe; known otherwise, it does not."""
    if motion.shape.any():
        return False
    return float(np.linalg.norm(motion.growth)) > _MOST_GROWTH * float(np.linalg.norm(motion.turn))


def _trusted(camera: ExposedCamera, rough: Fit) -> BoolArray:
    """Return which stars stay trusted: those that agree with most; all when too few do."""
    estimates = own_estimates(rough.evaluation, rough.scene, camera.free)
    before = rough.scene.trusted
    if estimates is None:
        return before
    had = np.flatnonzero(before)
    moved = path_lengths(camera.pinhole, rough.scene.motion, rough.scene.stars[had])
    turn = float(np.linalg.norm(rough.scene.motion.whole))
    angle = _END_FLOOR * turn / max(float(np.median(moved)), 1.0)
    floors = np.array([angle, angle, angle, _WIDTH_FLOOR])
    agree = agreeing(OwnEstimates(estimates.change[had], estimates.deviation[had]), floors, _TRUST_SIGMAS)
    if np.count_nonzero(agree) < max(camera.settings.least_stars, len(had) // 3):
        return before
    after = before.copy()
    after[had] = agree
    return after


def _affordable(camera: ExposedCamera, scene: Scene, more: float) -> BoolArray:
    """Return which stars (n,) the fit has room for: the trusted, of the others the brightest."""
    room = window_areas(camera.pinhole, scene, camera.settings.reach)
    order = np.lexsort((-scene.light, ~scene.trusted))
    needed = np.empty(len(room))
    needed[order] = np.cumsum(room[order])
    return np.asarray(scene.trusted | (needed <= more * _MOST_PIXELS))


def _accounted(camera: ExposedCamera, others: Scene) -> ExposedCamera:
    """Return the camera with a frame less the light of `others`, which is not known to the last electron."""
    if not len(others.light):
        return camera
    signal, floor = camera.frame.signal.copy(), camera.frame.floor.copy()
    count = len(others.light)
    for some in np.split(np.arange(count), range(_AT_ONCE, count, _AT_ONCE)):
        pixels, light = _modelled(camera, others.select(some))
        signal[pixels] -= light
        floor[pixels] += np.square(np.float32(_DOUBT) * light)
    return replace(camera, frame=replace(camera.frame, signal=signal, floor=floor))


def _modelled(camera: ExposedCamera, scene: Scene) -> tuple[IntArray, Float32Array]:
    """Return the pixels (m,) about the stars of `scene`, and its light there."""
    windows = camera.windows(scene)
    return windows.pixels, light_of(camera.pinhole, camera.shutter, scene, windows)
