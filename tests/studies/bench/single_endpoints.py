"""Single endpoints of the likelihood fit beside two bounds: `python -m tests.studies.bench endpoints`.

One streak alone fixes no rate, so the joint fit is asked with few stars, all of the magnitude that is judged,
on tracks of their own and no other star in the sky. Errors are over two bounds: of the same stars fitted
together, their point spread unknown (no unbiased estimator passes it), and of the streak alone, its point
spread known (`endpoint_bound`; a joint fit may pass it, since the stars share one motion). The bias is along
the streak, outward, with its standard error. The camera has 16 bits here: the bounds know of no clipped
pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.geometry import CameraMotion, paths, sensitivities
from knightcube.vision.streaks.streak_result import MotionResult
from sim_hal.star_camera import StarCameraModel, render
from tests.knightcube.vision.streaks.scenes import turn_of
from tests.sim_hal.star_camera.scenes import at_pixels, turning
from tests.studies.bench.streaks import estimated
from tests.support.scenes import FIELD, noise_floor
from tests.support.streak_bound import endpoint_bound, star_information

EXPOSURE = 0.2
STARS = 4
# px: between tracks, to the border, and between a star found and the one it is.
_APART = 40.0
_MARGIN = 12.0
_SAME = 5.0
_SHARED, _ALONE = 4, 4
# The columns of `sensitivities` of the turn, x and y.
_SENSITIVE = [0, 1, 2, 6, 7]


def endpoint_cell(magnitude: float, length: float, frames: int, seed: int) -> dict[str, Any]:
    """Return errors of single ends, along and across, over both bounds, and the bias along, px."""
    camera = StarCameraModel(field_of_view=FIELD, bits=16, full_well=1e6)
    electrons = float(camera.electrons(magnitude, EXPOSURE))
    floor = noise_floor(camera, EXPOSURE)
    rows: list[FloatArray] = []
    for frame in range(frames):
        rng = np.random.default_rng((seed, round(10.0 * magnitude), round(length), frame))
        places, turn = _tracks(rng, length, camera)
        times, attitudes = turning(turn / EXPOSURE, EXPOSURE)
        _, half = turning(0.5 * turn / EXPOSURE, EXPOSURE)
        directions = at_pixels(camera, places, half[-1])
        pixels = render(camera, directions, np.full(len(places), magnitude), times, attitudes, rng)
        found = estimated(pixels, turn / EXPOSURE, EXPOSURE, camera)
        if found.rate is not None:
            rows.append(_end_errors(found, places, turn, electrons, floor, camera))
    facts = {"magnitude": magnitude, "length": length, "ends": sum(map(len, rows)), "of": 2 * STARS * frames}
    # The ends of a frame share one motion: only frames are independent.
    means = np.array([row[:, 0].mean() for row in rows if len(row)])
    if len(means) < 2:
        return facts
    errors = np.concatenate(rows)
    alone = np.mean(
        [endpoint_bound(length, electrons, camera.psf_sigma, floor, angle) for angle in (0.3, 0.7)], axis=0
    )
    return {
        **facts,
        "bound_along": float(np.sqrt(np.mean(errors[:, 2] ** 2))),
        "over_joint": [float(np.sqrt(np.mean((errors[:, k] / errors[:, 2 + k]) ** 2))) for k in (0, 1)],
        "over_lone": [float(np.sqrt(np.mean(errors[:, k] ** 2)) / alone[k]) for k in (0, 1)],
        "bias": float(means.mean()),
        "bias_error": float(means.std(ddof=1) / np.sqrt(len(means))),
    }


def _tracks(
    rng: np.random.Generator, length: float, camera: StarCameraModel
) -> tuple[FloatArray, FloatArray]:
    """Return mid-exposure pixels (n, 2) of streaks that lie apart and in the frame, and the turn (3,) rad."""
    roll = rng.uniform(0.0, 2.0 * np.pi)
    turn = turn_of(0.5 * np.pi, length, roll, camera)
    # The axis is across the boresight, at `roll`: tracks are a distance along it apart.
    axis = np.array([np.cos(roll), np.sin(roll)])
    room = 0.6 * length + _MARGIN
    places: list[FloatArray] = []
    while len(places) < STARS:
        place = rng.uniform(room, camera.columns - 1 - room, 2)
        if all(abs(float((place - other) @ axis)) > _APART for other in places):
            places.append(place)
    return np.array(places), turn


def _end_errors(
    found: MotionResult,
    places: FloatArray,
    turn: FloatArray,
    electrons: float,
    floor: float,
    camera: StarCameraModel,
) -> FloatArray:
    """Return rows of error along (outward), across, and their joint bounds, px, of every end found."""
    pinhole, motion = camera.pinhole, CameraMotion.steady(turn)
    covariances = _joint_bounds(places, motion, electrons, floor, camera)
    rows = []
    for number, place in enumerate(places):
        distance = np.linalg.norm(found.stars - place, axis=1)
        index = int(distance.argmin())
        if distance[index] > _SAME:
            continue
        for end, time in enumerate((-0.5, 0.5)):
            there = paths(pinhole, motion, place[None], np.array([time]))
            outward = there.velocity[0] * np.sign(time) / np.linalg.norm(there.velocity[0])
            axes = np.stack([outward, np.array([-outward[1], outward[0]])])
            error = axes @ (found.endpoints[index, end] - there.position[0])
            bound = np.sqrt(np.diag(axes @ covariances[number, end] @ axes.T))
            rows.append(np.concatenate([error, bound]))
    return np.array(rows).reshape(-1, 4)


def _joint_bounds(
    places: FloatArray, motion: CameraMotion, electrons: float, floor: float, camera: StarCameraModel
) -> FloatArray:
    """Return the least covariances (n, 2, 2, 2) px^2 of both ends of stars that are fitted together."""
    pinhole = camera.pinhole
    informations = [
        star_information(pinhole, motion, place, electrons, camera.psf_sigma, floor) for place in places
    ]
    n = len(places)
    whole = np.zeros((_SHARED + _ALONE * n, _SHARED + _ALONE * n))
    own = [slice(_SHARED + _ALONE * k, _SHARED + _ALONE * (k + 1)) for k in range(n)]
    for information, part in zip(informations, own, strict=True):
        whole[:_SHARED, :_SHARED] += information[:_SHARED, :_SHARED]
        whole[:_SHARED, part] = information[:_SHARED, _SHARED:]
        whole[part, :_SHARED] = information[_SHARED:, :_SHARED]
        whole[part, part] = information[_SHARED:, _SHARED:]
    scale = np.sqrt(np.diag(whole))
    covariance = np.linalg.inv(whole / np.outer(scale, scale)) / np.outer(scale, scale)
    out = np.empty((n, 2, 2, 2))
    for k, part in enumerate(own):
        kept = [0, 1, 2, part.start, part.start + 1]
        geometry = covariance[np.ix_(kept, kept)]
        for end, time in enumerate((-0.5, 0.5)):
            change = sensitivities(pinhole, motion, places[k : k + 1], np.array([time]))[0][:, _SENSITIVE]
            out[k, end] = change @ geometry @ change.T
    return out


def pooled_bias(cells: Sequence[dict[str, Any]]) -> tuple[float, float] | None:
    """Return the mean bias, px, of cells by the inverse of their variances, and its error; None of none."""
    known = [cell for cell in cells if "bias" in cell]
    weight = np.array([cell["bias_error"] ** -2 for cell in known])
    if not known:
        return None
    return float(weight @ [cell["bias"] for cell in known] / weight.sum()), float(weight.sum() ** -0.5)
