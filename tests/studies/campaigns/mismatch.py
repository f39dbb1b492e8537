"""Campaigns `mismatch` and `vibration`: frames of cameras and motions that differ from the estimator's model.

`mismatch` uses each of `imperfections.IMPERFECTIONS` at rotations of 10 and 30 % of the field. `vibration`
adds a vibration of up to 5 px at 5 to 50 Hz with one of `SHAPES`, at exposures of 0.2 and 1 s. Pointings are
uniform over the sky, the axis is 0 to 90 deg off the boresight, and at least five stars must be usable
(`scenes.usable`).

The error of a result is given in claimed standard deviations (the square root of its NEES) and relative to
the rate. An error of more than 6 standard deviations counts as confidently wrong; its probability is 1 in 13
million. The true rate of a vibrating body is its mean rate between the attitudes at the ends of the exposure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray, Image, IntArray
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import LikelihoodSettings, StreakStatus
from sim_hal.star_camera import StarCameraModel
from tests.pace import warm_call
from tests.studies.campaigns.imperfections import IMPERFECTIONS, Imperfection
from tests.studies.campaigns.statistics import grouped, largest, mean, median, squared_sigmas
from tests.support.scenes import FIELD, catalogue, noise_floor
from tests.support.supersampled import Attitudes, Sky, light

TURNS = (10, 30)
EXPOSURES = (0.2, 1.0)
WRONG_SIGMAS = 6.0
WRONG_SHARE = 0.01
LEAST_USABLE = 5
_SIGNIFICANCE = 8.0
_MARGIN = 4.0
_MOST_SKIES = 1000
_VIBRATION_TURN = 10.0
# Smallest and largest amplitudes of a vibration, px.
_AMPLITUDES = ((0.2, 1.0), (1.0, 5.0))
SHAPES = ("sine", "two sines", "decaying", "noise")
"""Time profiles of a vibration. A decaying vibration loses 86 % of its amplitude during the exposure."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` random motions of each imperfection and rotation."""
    cells = [(name, percent) for name in IMPERFECTIONS for percent in TURNS]
    found = []
    for cell, (name, percent) in enumerate(cells):
        for run in range(runs):
            draw = np.random.default_rng((seed, cell, run, 0))
            parameters = {
                "row": name,
                "percent": float(percent),
                "exposure": float(draw.choice(EXPOSURES)),
                "theta": float(np.rad2deg(draw.uniform(0.0, 0.5 * np.pi))),
            }
            found.append(Case(f"{name} {percent} {run}", (seed, cell, run, 1), parameters))
    return found


def vibration_cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` vibrations that cycle through exposures and amplitudes; half of them are sinusoidal."""
    found = []
    for run in range(runs):
        draw = np.random.default_rng((seed, run, 0))
        exposure, (least, most) = EXPOSURES[run % 2], _AMPLITUDES[run // 2 % 2]
        parameters = {
            "row": f"{exposure:g} s, {least:g} to {most:g} px",
            "percent": _VIBRATION_TURN,
            "exposure": exposure,
            "theta": float(np.rad2deg(draw.uniform(0.0, 0.5 * np.pi))),
            "frequency": float(draw.uniform(5.0, 50.0)),
            "amplitude": float(draw.uniform(least, most)),
            "shape": SHAPES[int(draw.integers(len(SHAPES)))] if run // 4 % 2 else SHAPES[0],
        }
        found.append(Case(str(run), (seed, run, 1), parameters))
    return found


def attitudes_of(parameters: dict[str, Any], camera: StarCameraModel, rng: np.random.Generator) -> Attitudes:
    """Return a case's attitude as a function of time: random pointing, constant rate, and vibration."""
    theta, azimuth = np.deg2rad(parameters["theta"]), rng.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])
    turn = axis * parameters["percent"] / 100.0 * camera.field_of_view
    middle = normalise(rng.normal(size=4))
    way, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    shake = (
        parameters.get("amplitude", 0.0)
        / camera.pinhole.focal_length
        * np.array([np.cos(way), np.sin(way), 0.0])
    )
    cycles = parameters.get("frequency", 0.0) * parameters["exposure"]
    wave_of_time = wave(parameters.get("shape", SHAPES[0]), cycles, float(phase), rng)

    def at(times: FloatArray) -> FloatArray:
        steady = from_rotation_vector(times[:, None] * turn)
        shaking = from_rotation_vector(wave_of_time(times)[:, None] * shake)
        return multiply(shaking, multiply(steady, middle))

    return at


def wave(
    shape: str, cycles: float, phase: float, rng: np.random.Generator
) -> Callable[[FloatArray], FloatArray]:
    """Return a vibration of unit amplitude: a function of times (m,) in units of the exposure."""
    turn = 2.0 * np.pi * cycles
    if shape == "two sines":
        return lambda t: 0.6 * np.sin(turn * t + phase) + 0.4 * np.sin(1.7 * turn * t + 2.0 * phase)
    if shape == "decaying":
        return lambda t: np.exp(-2.0 * (t + 0.5)) * np.sin(turn * t + phase)
    if shape == "noise":
        share, phases = np.linspace(0.5, 1.5, 6)[:, None], rng.uniform(0.0, 2.0 * np.pi, (6, 1))
        return lambda t: np.asarray(np.sum(np.sin(turn * share * t + phases), axis=0)) / np.sqrt(6.0)
    return lambda t: np.sin(turn * t + phase)


def expose(case: Case, imperfection: Imperfection) -> tuple[Image, FloatArray]:
    """Return a case's frame and the true mean rate (3,) rad/s in the camera's frame."""
    camera, rng = StarCameraModel(field_of_view=FIELD), np.random.default_rng(case.seed)
    exposure = case.parameters["exposure"]
    _, attitudes, sky = usable_sky(camera, exposure, lambda: case.parameters, rng)
    length = 1.3 * case.parameters["percent"] / 100.0 * camera.columns + 60.0 * case.parameters.get(
        "amplitude", 0.0
    )
    electrons = light(
        camera.pinhole, imperfection.optics, sky, attitudes, length, imperfection.line_time / exposure, rng
    )
    return detected(electrons, imperfection, camera, exposure, rng), mean_rate(attitudes, exposure)


def usable_sky(
    camera: StarCameraModel, exposure: float, motion: Callable[[], dict[str, Any]], rng: np.random.Generator
) -> tuple[dict[str, Any], Attitudes, Sky]:
    """Return the parameters and attitudes of a motion, and the stars of a field with enough usable stars.

    Raises ValueError if no drawn field has enough usable stars.
    """
    stars, directions = catalogue(8.5)
    sky = Sky(directions, camera.electrons(stars.magnitude, exposure))
    for _ in range(_MOST_SKIES):
        parameters = motion()
        attitudes = attitudes_of(parameters, camera, rng)
        near, good = seen_stars(camera, sky, attitudes, exposure)
        if good >= LEAST_USABLE:
            return parameters, attitudes, Sky(directions[near], sky.electrons[near])
    raise ValueError(f"no sky in {_MOST_SKIES} with {LEAST_USABLE} usable stars for {parameters}")


def mean_rate(attitudes: Attitudes, exposure: float) -> FloatArray:
    """Return the mean rate (3,), rad/s, between the attitudes at the ends of an exposure."""
    begin, end = attitudes(np.array([-0.5, 0.5]))
    return np.asarray(to_rotation_vector(multiply(end, conjugate(begin))) / exposure)


def seen_stars(
    camera: StarCameraModel, sky: Sky, attitudes: Attitudes, exposure: float
) -> tuple[IntArray, int]:
    """Return the stars that may contribute to the frame, and the number of usable stars."""
    vectors = np.einsum("tij,nj->tni", attitude_matrix(attitudes(np.array([-0.5, 0.0, 0.5]))), sky.directions)
    reach = np.cos(camera.pinhole.half_diagonal + 0.4 * camera.field_of_view)
    near = np.flatnonzero(vectors[1, :, 2] > reach)
    place = camera.pinhole.project(vectors[:, near])
    inside = np.logical_and.reduce([camera.pinhole.contains(ends, -_MARGIN) for ends in place])
    length = np.linalg.norm(place[2] - place[0], axis=1)
    pixels = 4.0 * camera.psf_sigma * (length + 4.0 * camera.psf_sigma)
    noise = np.sqrt(noise_floor(camera, exposure) * pixels)
    return near, int(np.count_nonzero(inside & (sky.electrons[near] > _SIGNIFICANCE * noise)))


def detected(
    electrons: FloatArray,
    imperfection: Imperfection,
    camera: StarCameraModel,
    exposure: float,
    rng: np.random.Generator,
) -> Image:
    """Return the frame of an image in electrons, with photon noise, detector effects and digitisation."""
    if imperfection.electrons is not None:
        electrons = imperfection.electrons(electrons, rng)
    collected = rng.poisson(electrons + camera.dark_current * exposure).astype(float)
    if imperfection.collected is not None:
        collected = imperfection.collected(collected, rng)
    collected = np.minimum(collected, camera.full_well) + rng.normal(0.0, camera.read_noise, collected.shape)
    counts = collected / imperfection.gain + camera.pedestal
    if imperfection.counts is not None:
        counts = imperfection.counts(counts, rng)
    return imperfection.encode(counts)


def run(case: Case) -> Result:
    """Estimate the motion of one frame of an imperfect camera, and evaluate the result."""
    imperfection = IMPERFECTIONS[case.parameters["row"]]
    return judge(case, *expose(case, imperfection), imperfection)


def vibration_run(case: Case) -> Result:
    """Estimate the motion of one frame of a vibrating body, and evaluate the result."""
    imperfection = IMPERFECTIONS["none"]
    return judge(case, *expose(case, imperfection), imperfection)


def judge(case: Case, pixels: Image, rate: FloatArray, imperfection: Imperfection) -> Result:
    """Return status, errors and time of the estimator on a frame; the true `rate` (3,) is also the prior."""
    camera = StarCameraModel(field_of_view=FIELD)
    settings = LikelihoodSettings(
        **{"gain": camera.gain, "saturation": imperfection.top, "line_time": 0.0, **imperfection.known}
    )
    exposure = case.parameters["exposure"]
    found, spent = warm_call(
        "mismatch", lambda: estimate_motion(pixels, camera.pinhole, exposure, settings, rate, 0.0)
    )
    result = {
        **case.parameters,
        "seed": list(case.seed),
        "status": found.status.value,
        "nees": None,
        "share": None,
    }
    result["milliseconds"] = 1e3 * spent
    result["misfit"] = found.misfit if np.isfinite(found.misfit) else None
    if found.status is StreakStatus.RATE and found.rate is not None and found.covariance is not None:
        error = found.rate - rate
        result["nees"] = squared_sigmas(error, found.covariance)
        result["share"] = float(np.linalg.norm(error) / np.linalg.norm(rate))
        result["claimed"] = float(np.sqrt(np.trace(found.covariance)) / np.linalg.norm(rate))
    return result


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return availability and errors of each row, and of all rows together."""
    rows = {name: _figures(own) for name, own in grouped(results, "row", "percent").items()}
    worst = sorted((r for r in results if r["nees"] is not None), key=lambda r: -r["nees"])[:10]
    return summary({"rows": rows, "all": _figures(results), "worst": worst})


def _figures(results: Sequence[Result]) -> dict[str, Any]:
    answers = [r for r in results if r["nees"] is not None]
    nees, share = np.array([r["nees"] for r in answers]), np.array([r["share"] for r in answers])
    return {
        "frames": len(results),
        "answers": len(answers),
        "worst_sigmas": largest(np.sqrt(nees)),
        "nees": mean(nees),
        "worst_share": largest(share),
        "claimed": median([r["claimed"] for r in answers]),
        "beyond_sigmas": int(np.count_nonzero(nees > WRONG_SIGMAS**2)),
        "beyond_share": int(np.count_nonzero(share > WRONG_SHARE)),
        "milliseconds": float(np.median([r["milliseconds"] for r in results])),
    }
