"""A slew of the 3U satellite with a camera frame every 5 s."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flight.link.telemetry.packets import to_text
from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig, TargetStep, as_orbit
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_rotation_vector, multiply
from sim_hal.settings import Simulation
from tests.scenario.orbit_flights import skyward

CONFIG = Path(__file__).resolve().parents[2] / "config" / "orbit_3u.yaml"


SPEED = 5e-4
"""Body rate (rad/s) when the satellite is released."""


BEGIN, SLEW, TURN = 60.0, 300.0, np.radians(100.0)
"""Start (s), duration (s) and angle (rad) of the slew."""


def flight(body: str, seed: int, about: FloatArray | None = None) -> tuple[OrbitConfig, Simulation]:
    """Return configuration and world of a slew about `about` (3,), body axes, or a random axis."""
    text = CONFIG.read_text(encoding="utf-8")
    config = as_orbit(configuration.parse(text))
    section = configuration.simulation_section(text, CONFIG.name, Simulation)
    assert section is not None
    assert section.free_body is not None
    assert config.camera is not None
    away = skyward().free_body
    assert away is not None
    assert away.release.attitude is not None
    start = away.release.attitude
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3) if about is None else about
    end = multiply(from_rotation_vector(TURN * axis / np.linalg.norm(axis)), np.array(start))
    x, y, z, w = end.tolist()
    release = configuration.replace(section.free_body.release, attitude=start, speed=SPEED)
    world = configuration.replace(
        section, seed=seed, free_body=configuration.replace(section.free_body, release=release)
    )
    return configuration.replace(
        config,
        body=body,
        duration=BEGIN + SLEW + 10.0,
        camera=configuration.replace(config.camera, fine_period=None),
        detumble=configuration.replace(config.detumble, low_rate=0.0175, low_for=0.5),
        pointing=configuration.replace(config.pointing, slew=SLEW),
        targets=(
            TargetStep(at=0.0, point="inertial", quaternion=start),
            TargetStep(at=BEGIN, point="inertial", quaternion=(x, y, z, w)),
        ),
    ), world


def _mounting() -> float:
    """Return the standard deviation (rad per axis) of a mounting error that is uniform within its limit."""
    camera = as_orbit(configuration.parse(CONFIG.read_text(encoding="utf-8"))).camera
    assert camera is not None
    return float(np.radians(camera.accuracy.mounting_deg) / np.sqrt(3.0))


def compared(
    run: Run, first: float = BEGIN + 5.0, last: float = BEGIN + SLEW
) -> tuple[int, int, int, FloatArray]:
    """Return three counts of the slew's frames (all, with a rate, used), and the NEES per axis (n,).

    Only frames from `first` to `last` (s) are counted. Rates are compared in body axes. The covariance of a
    frame is in camera axes, and the accuracy of the camera's mounting is added.
    """
    frames, truth = run["streak"], run["truth"]
    times, rates = truth["time_ns"] * 1e-9, truth["rate"].astype(float)
    began = frames["exposure_start_ns"] * 1e-9
    within = (began > first) & (began < last)
    found = []
    for frame in frames[within]:
        if to_text(frame["status"]) != "rate":
            continue
        begin = float(frame["exposure_start_ns"]) * 1e-9
        at = np.linspace(begin, begin + float(frame["exposure"]), 201)
        mean = np.mean([np.interp(at, times, part) for part in rates.T], axis=1)
        xx, yy, zz, xy, xz, yz = frame["covariance"].astype(float)
        covariance = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        rotation = np.cross(np.eye(3), mean)  # change of the rate by a misalignment of the camera
        covariance += _mounting() ** 2 * rotation.T @ rotation
        error = frame["rate"].astype(float) - mean
        found.append(error @ np.linalg.solve(covariance, error) / 3.0)
    return int(within.sum()), len(found), int(frames["accepted"][within].sum()), np.array(found)
