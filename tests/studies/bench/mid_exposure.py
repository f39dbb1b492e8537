"""The attitude at mid-exposure from a fit's stars, the true ones being known, and its least error.

`python -m tests.studies bench mid_exposure`. Each star used in the fit is named by the true star whose
path has both ends near its own; ESOQ2 takes its direction with an error that is the mean of both axes of its
covariance. `refined` weighs the stars' pixels by their whole covariances, since along a streak a star is
known several times worse than across, and does without stars that disagree with the rest by more than chance
allows, the worst first: light of fainter stars hides in some streaks. `agreed` is ESOQ2 of those that remain.

`flight` is the star tracker's own answer to the same fit, told roughly where the camera looks, and
`known sky` its answer after the second fit, with the light of unseen stars taken out
(`knightcube.vision.startracker.catalogue_refit`); the rates of both fits are held against their bound too.

The bound: all pixels of the brightest stars, whose directions are known and whose light and background are
not, the turn, the width of the point spread and the attitude common to all (Fisher information as in
`tests.support.streak_bound`).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray, Image, cross_matrices
from knightcube.astro.attitude.solvers import SOLVERS
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.errors import FlightError
from knightcube.vision.camera.lens import EXACT, Pinhole
from knightcube.vision.startracker.catalogue_refit import refit_with_catalogue
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.solve import AttitudePrior, FrameSolution, SolveSettings, solve_motion
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.geometry import CameraMotion
from knightcube.vision.streaks.settings import LikelihoodSettings
from knightcube.vision.streaks.streak_result import MotionResult
from sim_hal.star_camera import StarCameraModel
from tests.studies.campaigns import streaks as campaign
from tests.support.attitude_errors import attitude_error, error_in_pixels
from tests.support.scenes import FIELD, Scene, noise_floor, slew
from tests.support.streak_bound import star_information

_MATCH_PX = 6.0
_STARS = 30
# Turn (3), point spread, then attitude (3) or a star's x and y.
_SHARED = 4
_ROUNDS = 2
# Chi-square of 2, exceeded by chance once in 1000: a star farther off is not where its pixels say.
_FARTHEST = 13.8
_LEAST_STARS = 4
EXPOSURE = 0.2
SOLUTIONS = ("all stars", "agreed", "refined", "flight", "known sky")
FITS = ("first", "known sky")
# rad: by how much the tracker's prior is wrong about each axis, and believed to be.
_PRIOR_ERROR, _PRIOR_SIGMA = np.array([2e-4, -1e-4, 1e-4]), 3e-4
# Median of the distance of a point whose two coordinates have the rms distance 1.
_RAYLEIGH_MEDIAN = float(np.sqrt(np.log(2.0)))


def estimated(pixels: Image, rate: FloatArray, exposure: float, camera: StarCameraModel) -> MotionResult:
    """Return what the likelihood estimator says of a frame; the true `rate` (3,) only gives the sign."""
    settings = LikelihoodSettings(saturation=float(camera.highest_count), gain=camera.gain, knowledge=EXACT)
    return estimate_motion(pixels, camera.pinhole, exposure, settings, rate, 0.0)


def scenes(
    camera: StarCameraModel,
    frames: int,
    percent: float,
    thetas: tuple[float, float],
    exposure: float,
    seed: tuple[int, ...],
    faintest: float,
) -> list[Scene]:
    """Return frames of a turn of `percent` of the field, theta spread evenly over `thetas` deg.

    The sky holds stars down to magnitude `faintest`.
    """
    found = []
    for frame in range(frames):
        generator = np.random.default_rng((*seed, round(10.0 * percent), frame))
        # One theta from each of `frames` equal parts of the range.
        theta = thetas[0] + (thetas[1] - thetas[0]) * (frame + generator.uniform()) / frames
        angle, fraction = float(np.deg2rad(theta)), percent / 100.0
        found.append(slew(generator, angle, fraction, exposure, faintest, camera))
    return found


@dataclass(frozen=True, slots=True)
class MidAttitude:
    """An attitude at mid-exposure.

    Attributes:
        quaternion: (4,) ICRS into camera, by ESOQ2 of all stars; `agreed` (4,) of those that agree;
            `refined` (4,) of the same by whole covariances.
        dropped: part of the stars that do not agree.
        sigma_across: rad, what the covariances say of the error of `refined`'s boresight, rms.
    """

    quaternion: FloatArray
    agreed: FloatArray
    refined: FloatArray
    dropped: float
    sigma_across: float


def mid_attitude(found: MotionResult, scene: Scene, pinhole: Pinhole) -> MidAttitude | None:
    """Return the attitude from the stars used, None when they are too few to fix one."""
    used = np.flatnonzero(found.used)
    star = _true_stars(found.endpoints[used], scene)
    used, star = used[star >= 0], star[star >= 0]
    stars = Seen(found.stars[used], found.star_covariance[used], scene.directions[star], pinhole)
    try:
        all_of_them = stars.attitude()
        refined, covariance = stars.refined(all_of_them)
        while len(stars.places) > _LEAST_STARS:
            missed = stars.disagreement(refined)
            if missed.max() <= _FARTHEST:
                break
            stars = stars.without(int(missed.argmax()))
            refined, covariance = stars.refined(refined)
        agreed = stars.attitude()
    except FlightError:
        return None
    sigma = float(np.sqrt(covariance[0, 0] + covariance[1, 1]))
    return MidAttitude(all_of_them, agreed, refined, 1.0 - len(stars.places) / len(used), sigma)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Identified stars: `places` (n, 2) px, `covariance` (n, 2, 2) px^2, `reference` (n, 3) ICRS."""

    places: FloatArray
    covariance: FloatArray
    reference: FloatArray
    pinhole: Pinhole

    def without(self, index: int) -> Seen:
        """Return all stars but one."""
        kept = np.delete(np.arange(len(self.places)), index)
        return Seen(self.places[kept], self.covariance[kept], self.reference[kept], self.pinhole)

    def attitude(self) -> FloatArray:
        """Return the attitude (4,) by ESOQ2; raises AttitudeError when the stars fix none."""
        sigma = np.sqrt(0.5 * np.trace(self.covariance, axis1=1, axis2=2)) / self.pinhole.focal_length
        return SOLVERS["esoq2"](self.pinhole.unit_vectors(self.places), self.reference, sigma).quaternion

    def disagreement(self, quaternion: FloatArray) -> FloatArray:
        """Return each star's squared distance (n,) from where the attitude puts it, in its deviations."""
        missed = self.places - self.pinhole.project(self.reference @ attitude_matrix(quaternion).T)
        return np.asarray(np.einsum("na,nab,nb->n", missed, np.linalg.inv(self.covariance), missed))

    def refined(self, quaternion: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the attitude (4,) of least squares in the image, and its covariance (3, 3) rad^2."""
        weight = np.linalg.inv(self.covariance)
        for _ in range(_ROUNDS):
            seen = self.reference @ attitude_matrix(quaternion).T
            change = _by_attitude(seen, self.pinhole)
            normal = np.einsum("nai,nab,nbj->ij", change, weight, change)
            missed = self.places - self.pinhole.project(seen)
            step = np.linalg.solve(normal, np.einsum("nai,nab,nb->i", change, weight, missed))
            quaternion = multiply(from_rotation_vector(step), quaternion)
        return quaternion, np.asarray(np.linalg.inv(normal))


def _true_stars(ends: FloatArray, scene: Scene) -> FloatArray:
    """Return the index (n,) of the star whose path has both ends near `ends` (n, 2, 2) px, -1 without one."""
    true = np.stack([scene.start, scene.end], axis=1)
    worst = np.linalg.norm(true[None] - ends[:, None], axis=-1).max(axis=-1)
    worst = np.where(np.isfinite(worst), worst, np.inf)
    nearest = worst.argmin(axis=1)
    return np.where(worst[np.arange(len(ends)), nearest] < _MATCH_PX, nearest, -1)


def _by_attitude(vectors: FloatArray, pinhole: Pinhole) -> FloatArray:
    """Return d(pixel)/d(small turn of the camera), (n, 2, 3), of directions (n, 3): v moves by v x psi."""
    x, y, z = vectors.T
    projected = np.zeros((len(vectors), 2, 3))
    projected[:, 0, 0] = projected[:, 1, 1] = 1.0 / z
    projected[:, 0, 2], projected[:, 1, 2] = -x / z**2, -y / z**2
    return np.asarray(pinhole.focal_length * projected @ cross_matrices(vectors))


def across_bound(scene: Scene, camera: StarCameraModel) -> float:
    """Return the least rms error of the boresight's direction, rad, of any unbiased attitude.

    Raises numpy.linalg.LinAlgError when the stars fix none.
    """
    pinhole = camera.pinhole
    seen = np.flatnonzero(
        np.any([pinhole.contains(place) for place in (scene.start, scene.middle, scene.end)], axis=0)
    )
    brightest = seen[np.argsort(-scene.electrons[seen], kind="stable")][:_STARS]
    motion = CameraMotion.steady(scene.rate * scene.exposure)
    floor = noise_floor(camera, scene.exposure)
    total = np.zeros((_SHARED + 3, _SHARED + 3))
    change = _by_attitude(pinhole.unit_vectors(scene.middle[brightest]), pinhole)
    for place, electrons, moved in zip(
        scene.middle[brightest], scene.electrons[brightest], change, strict=True
    ):
        information = star_information(pinhole, motion, place, float(electrons), camera.psf_sigma, floor)
        geometry = slice(None, _SHARED + 2)
        light = slice(_SHARED + 2, None)
        known = np.linalg.pinv(information[light, light], hermitian=True)
        left = information[geometry, geometry] - (
            information[geometry, light] @ known @ information[light, geometry]
        )
        chain = np.zeros((_SHARED + 2, _SHARED + 3))
        chain[:_SHARED, :_SHARED] = np.eye(_SHARED)
        chain[_SHARED:, _SHARED:] = moved
        total += chain.T @ left @ chain
    scale = np.sqrt(np.diag(total))
    if not np.all(scale > 0.0):
        raise np.linalg.LinAlgError("the stars do not fix the attitude")
    covariance = np.linalg.inv(total / np.outer(scale, scale)) / np.outer(scale, scale)
    return float(np.sqrt(covariance[4, 4] + covariance[5, 5]))


def tracked(
    found: MotionResult, scene: Scene, camera: StarCameraModel, truth: FloatArray
) -> tuple[FrameSolution, FrameSolution]:
    """Return what the star tracker makes of the fit, and of a second one with all stars known."""
    settings = SolveSettings(
        likelihood=LikelihoodSettings(saturation=float(camera.highest_count), gain=camera.gain, line_time=0.0)
    )
    prior = AttitudePrior(multiply(from_rotation_vector(_PRIOR_ERROR), truth), _PRIOR_SIGMA)
    first = solve_motion(found, camera.pinhole, (1.0, 1.0), default_index(), settings, prior)
    return first, refit_with_catalogue(scene.pixels, first, default_index(), settings, settings.likelihood)


def attitude_row(percent: float, frames: int, seed: int, faintest: float, exposure: float) -> dict[str, Any]:
    """Return errors of the attitude at mid-exposure across the boresight, px, and over the bound."""
    camera = StarCameraModel(field_of_view=FIELD)
    errors, bounds, claimed, dropped, rates = [], [], [], [], []
    for scene in scenes(camera, frames, percent, (0.0, 90.0), exposure, (seed, 3), faintest):
        found = estimated(scene.pixels, scene.rate, exposure, camera)
        least = campaign._bound(scene, camera)
        fix = mid_attitude(found, scene, camera.pinhole) if found.rate is not None else None
        if fix is None or least is None:
            continue
        half = from_rotation_vector(0.5 * scene.rate * scene.exposure)
        truth = multiply(half, scene.attitudes[0])
        solved = tracked(found, scene, camera, truth)
        motions, fixes = [one.motion for one in solved], [one.fix for one in solved]
        attitudes = [fix.quaternion, fix.agreed, fix.refined]
        attitudes += [np.full(4, np.nan) if one is None else one.quaternion for one in fixes]
        errors.append([attitude_error(quaternion, truth)[1] for quaternion in attitudes])
        bounds.append(across_bound(scene, camera))
        claimed.append(
            [fix.sigma_across]
            + [np.nan if f is None else np.sqrt(np.trace(f.covariance[:2, :2])) for f in fixes]
        )
        dropped.append(fix.dropped)
        size = float(np.linalg.norm(scene.rate))
        rates.append(
            [
                float(np.linalg.norm(one.rate - scene.rate)) / size / least[1]
                for one in motions
                if one is not None and one.rate is not None
            ]
        )
    angles = np.array(errors).reshape(-1, len(SOLUTIONS))
    least_angles = np.array(bounds)
    pixel = error_in_pixels(1.0, camera.columns, camera.field_of_view)
    over_claimed = angles[:, 2:] / np.array(claimed).reshape(-1, 3)
    return {
        "percent": percent,
        "attitudes": len(angles),
        "frames": frames,
        "bound_px": _root_mean_square(pixel * least_angles),
        "solutions": {name: _figures(angles[:, k], least_angles, pixel) for k, name in enumerate(SOLUTIONS)},
        "dropped": float(np.mean(dropped)) if dropped else None,
        "over_claimed": {name: _root_mean_square(over_claimed[:, k]) for k, name in enumerate(SOLUTIONS[2:])},
        "rate_over_bound": {
            name: _root_mean_square(np.array(rates)[:, k]) if rates else None for k, name in enumerate(FITS)
        },
    }


def _figures(angles: FloatArray, least: FloatArray, pixel: float) -> dict[str, Any]:
    """Return how many attitudes (n,) rad there are, NaN for none, and their errors, px and over the bound."""
    there = np.isfinite(angles)
    if not there.any():
        return {"attitudes": 0}
    ratio = angles[there] / least[there]
    pixels = pixel * angles[there]
    return {
        "attitudes": int(np.count_nonzero(there)),
        "rms_px": float(np.sqrt(np.mean(pixels**2))),
        "median_px": float(np.median(pixels)),
        "largest_px": float(pixels.max()),
        "over_bound": float(np.sqrt(np.mean(ratio**2))),
        "over_bound_median": float(np.median(ratio) / _RAYLEIGH_MEDIAN),
    }


def _root_mean_square(values: FloatArray) -> float | None:
    """Return that of the values that there are, None without any."""
    there = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(there)))) if len(there) else None


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, or one JSON object; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies bench mid_exposure", description=__doc__)
    parser.add_argument(
        "--frames", type=int, default=20, help="frames for each rotation (default %(default)s)"
    )
    parser.add_argument(
        "--percent", type=float, nargs="+", default=[10.0, 20.0, 35.0, 50.0], help="of the field"
    )
    parser.add_argument(
        "--faintest", type=float, default=8.5, help="magnitude of the faintest star (default %(default)s)"
    )
    parser.add_argument("--exposure", type=float, default=EXPOSURE, help="in s (default %(default)s)")
    parser.add_argument("--seed", type=int, default=14_142, help="default %(default)s")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    options = parser.parse_args(arguments)
    rows = [
        attitude_row(percent, options.frames, options.seed, options.faintest, options.exposure)
        for percent in options.percent
    ]
    if options.json:
        sys.stdout.write(
            json.dumps({"seed": options.seed, "exposure": options.exposure, "attitude": rows}) + "\n"
        )
        return 0
    sys.stdout.write(
        "turn %  solution     attitudes  rms px  median  largest  bound px  rms x bound  median x bound\n"
    )
    for row in rows:
        for name, one in row["solutions"].items():
            if one["attitudes"]:
                sys.stdout.write(
                    f"{row['percent']:6.0f}  {name:10} {one['attitudes']:3d}/{row['frames']:<3d}     "
                    f" {one['rms_px']:7.4f} {one['median_px']:7.4f} {one['largest_px']:8.4f}"
                    f" {row['bound_px']:9.4f} {one['over_bound']:12.2f} {one['over_bound_median']:15.2f}\n"
                )
    return 0
