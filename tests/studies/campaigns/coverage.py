"""Campaign `coverage`: stars, Sun and limb in view of the cameras of VT, UW and USU.

It repeats section 4 of Meller et al. Each run is one revolution of the paper's orbit with a random date and
node, for each camera suite and each kind of attitude: level, rolled and pitched by up to 15 deg (4.1),
pitched back and forth by 90 deg (4.3), and random. The campaign reports the share of time in which 0, 1, 2,
... cameras have the horizon, lit or not, in view, and the share of the sunlit time in which a camera has the
Sun in view. For UW in level attitude, the latter is given over the Sun's elevation above the orbital plane
(beta), for three headings of the hexagon, and for the square detector and its inscribed cone, because the
paper states neither heading nor field shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from knightcube.astro.almanac import apparent_sun
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, sunlit_share
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, normalise
from tests.support.orbit_geometry import (
    SUITES,
    Pass,
    in_cone,
    in_field,
    limb,
    limb_in_daylight,
    local_frame,
    revolution,
    suite,
)
from tests.support.orbit_world import FIRST_DATE
from tests.support.sensor_suite import SensorSuite

STEP = 20.0
MOST_TILT = np.radians(15.0)
ATTITUDES = ("level", "within 15 deg", "tipped 90 deg", "any")
HEADINGS = {"two to the Sun's side": -90.0, "one forward": 0.0, "one to the Sun's side": 90.0}
"""Azimuth (deg) of the first camera, measured from the flight direction towards the Sun's side of the orbital
plane.
"""
BEST = "two to the Sun's side"
BETA_STEP = 5.0
PAPER = 74.0
LEAST_ARC = 5
"""Smallest number of visible limb points, of 720, that count as a horizon: 2.5 deg of the limb."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` random revolutions, and the fixed table of headings."""
    drawn = [Case(f"orbit/{run}", (seed, run), {"kind": "orbit"}) for run in range(runs)]
    betas = np.arange(0.0, 75.1, BETA_STEP)
    return drawn + [
        Case(f"heading/{beta:g}", (seed,), {"kind": "heading", "beta": float(beta)}) for beta in betas
    ]


def run(case: Case) -> Result:
    """Evaluate the fields of view over one revolution."""
    if case.parameters["kind"] == "heading":
        return {**case.parameters, "shares": sun_by_heading(suite("uw"), np.radians(case.parameters["beta"]))}
    rng = np.random.default_rng(case.seed)
    way = revolution(FIRST_DATE + rng.uniform(0.0, 365.25), rng.uniform(0.0, 2.0 * np.pi), STEP)
    frame = local_frame(way.positions, way.velocities)
    sun = _sun(way)
    sun_local = np.einsum("nij,nj->ni", frame, sun)
    lit = sunlit_share(way.positions, ASTRONOMICAL_UNIT * sun) > 0.5
    edge = limb(way.positions)
    day = limb_in_daylight(way.positions, edge, sun_local)
    shares = {}
    for attitude in ATTITUDES:
        turn = attitude_matrix(_attitudes(attitude, len(lit), rng))
        edge_body = np.einsum("nij,npj->npi", turn, edge)
        sun_body = np.einsum("nij,nj->ni", turn, sun_local)
        for name in SUITES:
            shares[f"{name}/{attitude}"] = _shares(suite(name), edge_body, day, sun_body, lit)
    beta = np.degrees(np.arcsin(np.clip(-sun_local[:, 1], -1.0, 1.0)))
    return {**case.parameters, "beta": float(np.mean(beta)), "sunlit": float(np.mean(lit)), "shares": shares}


def _shares(
    sensors: SensorSuite, edge: FloatArray, day: BoolArray, sun: FloatArray, lit: BoolArray
) -> dict[str, Any]:
    """Return the shares of time with the horizon (lit, or any) in 0 to n cameras, and with the Sun in one."""
    count, count_day = np.zeros(len(lit), int), np.zeros(len(lit), int)
    seen = np.zeros(len(lit), bool)
    for camera in sensors.cameras:
        inside = in_field(camera, edge)
        count += np.count_nonzero(inside, axis=-1) >= LEAST_ARC
        count_day += np.count_nonzero(inside & day, axis=-1) >= LEAST_ARC
        if camera.sun:
            seen |= in_field(camera, sun)
    most = len(sensors.cameras) + 1
    return {
        "horizon": (np.bincount(count, minlength=most) / len(lit)).tolist(),
        "lit horizon": (
            np.bincount(count_day[lit], minlength=most) / max(1, int(np.count_nonzero(lit)))
        ).tolist(),
        "sun": float(np.mean(seen[lit])) if np.any(lit) else 0.0,
    }


def _attitudes(kind: str, n: int, rng: np.random.Generator) -> FloatArray:
    """Return attitudes (n, 4) from the local vertical frame to the body frame."""
    if kind == "level":
        return from_rotation_vector(np.zeros((n, 3)))
    if kind == "within 15 deg":
        direction, tilt = rng.uniform(0.0, 2.0 * np.pi, n), MOST_TILT * np.sqrt(rng.random(n))
        return from_rotation_vector(
            tilt[:, None] * np.stack([np.cos(direction), np.sin(direction), np.zeros(n)], axis=-1)
        )
    if kind == "tipped 90 deg":
        return from_rotation_vector(np.outer(np.linspace(-0.5 * np.pi, 0.5 * np.pi, n), [0.0, 1.0, 0.0]))
    return normalise(rng.standard_normal((n, 4)))


def _sun(way: Pass) -> FloatArray:
    """Return the Sun's directions (n, 3), held constant because the Sun moves by 0.06 deg in a revolution."""
    seen, _ = apparent_sun(way.julian_date, way.positions[0], way.velocities[0])
    return np.broadcast_to(seen, way.positions.shape)


def sun_by_heading(sensors: SensorSuite, beta: float) -> dict[str, dict[str, float]]:
    """Return the share of the sunlit orbit with the Sun in a camera, by heading and by field shape.

    `beta` (rad) is the Sun's elevation above the plane of a circular orbit around a sphere, positive to the
    right.
    """
    along = np.linspace(0.0, 2.0 * np.pi, 2881)[:-1]
    sun = np.stack(
        [np.cos(beta) * np.sin(along), np.full_like(along, np.sin(beta)), -np.cos(beta) * np.cos(along)],
        axis=-1,
    )
    radius = np.linalg.norm(revolution(FIRST_DATE, 0.0, 6000.0).positions[0])
    lit = sunlit_share(np.broadcast_to([0.0, 0.0, -radius], sun.shape), ASTRONOMICAL_UNIT * sun) > 0.5
    found: dict[str, dict[str, float]] = {}
    for heading, degrees in HEADINGS.items():
        # The body is yawed so that its first camera, at azimuth 0, points along the heading.
        turn = attitude_matrix(from_rotation_vector(np.array([0.0, 0.0, np.radians(degrees)])))
        body = sun[lit] @ turn.T
        found[heading] = {
            shape: float(np.mean(np.any([inside(camera, body) for camera in sensors.cameras], axis=0)))
            for shape, inside in (("square", in_field), ("cone", in_cone))
        }
    return found


def all_three_up_to(name: str = "vt") -> float:
    """Return the largest tilt (rad), in any direction, at which every camera has the horizon in view."""
    edge = limb(revolution(FIRST_DATE, 0.0, 6000.0).positions[:1])[0]
    direction = np.radians(np.arange(0.0, 360.0, 5.0))
    axes = np.stack([np.cos(direction), np.sin(direction), np.zeros_like(direction)], axis=-1)

    def all_see(tilt: float) -> bool:
        body = np.einsum("nij,pj->npi", attitude_matrix(from_rotation_vector(tilt * axes)), edge)
        counts = [np.count_nonzero(in_field(camera, body), axis=-1) for camera in suite(name).cameras]
        return bool(np.min(counts) >= LEAST_ARC)

    least, most = 0.0, float(np.radians(90.0))
    while most - least > 1e-4:
        middle = 0.5 * (least + most)
        least, most = (middle, most) if all_see(middle) else (least, middle)
    return least


def summarise(results: Sequence[Result], out: Path) -> Summary:
    """Return mean shares of time in which the cameras see horizon and Sun, for each suite of cameras.

    For the suite UW, the share of the Sun is also given by heading and by elevation of the Sun.
    """
    orbits = [result for result in results if result["kind"] == "orbit"]
    tables = [result for result in results if result["kind"] == "heading"]
    facts: dict[str, Any] = {"orbits": len(orbits), "suites": _mean_shares(orbits)}
    facts["sunlit"] = float(np.mean([result["sunlit"] for result in orbits]))
    facts["vt_all_three_up_to_deg"] = float(np.degrees(all_three_up_to()))
    facts["uw_sun_by_beta"] = {f"{r['beta']:g}": r["shares"] for r in tables}
    facts["betas_of_paper"] = {
        shape: [
            (heading, result["beta"])
            for result in tables
            for heading in HEADINGS
            if abs(100.0 * result["shares"][heading][shape] - PAPER) <= 3.0
        ]
        for shape in ("square", "cone")
    }
    facts["uw_sun_over_year"] = _over_year(orbits, tables)
    return summary(facts)


def _mean_shares(orbits: Sequence[Result]) -> dict[str, Any]:
    found = {}
    for key in orbits[0]["shares"]:
        mine = [orbit["shares"][key] for orbit in orbits]
        found[key] = {
            "horizon": np.mean([m["horizon"] for m in mine], axis=0).tolist(),
            "lit horizon": np.mean([m["lit horizon"] for m in mine], axis=0).tolist(),
            "sun": float(np.mean([m["sun"] for m in mine])),
            "least_cameras": int(min(np.flatnonzero(m["horizon"])[0] for m in mine)),
        }
    return found


def _over_year(orbits: Sequence[Result], tables: Sequence[Result]) -> dict[str, float]:
    """Return UW's mean share of time with the Sun in view, for its first camera on the Sun's side."""
    betas = [result["beta"] for result in tables]
    return {
        shape: float(
            np.mean(
                np.interp(
                    [abs(orbit["beta"]) for orbit in orbits],
                    betas,
                    [result["shares"][BEST][shape] for result in tables],
                )
            )
        )
        for shape in ("square", "cone")
    }


COVERAGE = Campaign(
    "coverage",
    "share of an orbit with horizon and Sun in the cameras of VT, UW, USU",
    cases,
    run,
    summarise,
    60,
)
