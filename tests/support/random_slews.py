"""Random slews of two satellites, each in two orbits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import Ephemeris, predict
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.quaternion import from_rotation_vector, multiply, normalise
from knightcube.gnc.guidance.slew_model import (
    AttitudeEnd,
    EndLaw,
    SlewCraft,
    SlewTask,
    along,
    cones,
)
from knightcube.gnc.guidance.slew_plan import SlewPlan
from tests.support.recorded_slews import matrix

CRAFT = {
    "1U": (
        SlewCraft(np.diag([1.10e-3, 1.05e-3, 0.99e-3]), np.full(3, 0.0959), np.full(3, 54.8)),
        (80.0, 400.0),
    ),
    "3U": (SlewCraft(np.diag([0.0066, 0.0333, 0.0333]), np.full(3, 0.2), np.full(3, 5.0)), (300.0, 1200.0)),
}


ORBITS = {"ISS": (420e3, 51.6), "SSO": (500e3, 97.4)}


STAR_CAMERA: FloatArray = np.array([0.0, -1.0, 0.0])


_DATE = 2_461_101.0  # 2026-03-01


_REVOLUTION = 5600.0


_LONGEST = 3.0


@cache
def orbit(name: str) -> Ephemeris:
    """Return the prediction of an orbit over two revolutions."""
    height, tilt = ORBITS[name]
    radius, tilt = EARTH_RADIUS + height, np.radians(tilt)
    speed = np.sqrt(GRAVITATIONAL_PARAMETER / radius)
    velocity = speed * np.array([0.0, np.cos(tilt), np.sin(tilt)])
    return predict(OrbitState(_DATE, np.array([radius, 0.0, 0.0]), velocity, 0.0), 2.0 * _REVOLUTION)


def _whenever(end: AttitudeEnd) -> EndLaw:
    return lambda _: end


def slews(count: int, seed: int, with_cones: bool) -> Iterator[tuple[str, SlewTask]]:
    """Yield slew tasks with their names.

    With exclusion cones, all tasks start and end outside of the cones.
    """
    rng = np.random.default_rng(seed)
    made = 0
    while made < count:
        craft, name = list(CRAFT)[made % 2], list(ORBITS)[made // 2 % 2]
        model, (least, most) = CRAFT[craft]
        horizon, begin = (
            float(np.exp(rng.uniform(np.log(least), np.log(most)))),
            rng.uniform(0.0, _REVOLUTION),
        )
        q = normalise(rng.normal(size=4))
        angle = rng.uniform(30.0, 180.0)
        turn = np.radians(angle) * normalise(rng.normal(size=3))
        target = AttitudeEnd(multiply(from_rotation_vector(turn), q), np.zeros(3))
        path = orbit(name)
        kept = cones(path, begin, STAR_CAMERA, sun=0.4, earth=0.15, moon=0.2) if with_cones else ()
        task = SlewTask(
            model, along(path, begin), q, np.zeros(3), _whenever(target), horizon, _LONGEST * horizon
        )
        ends = ((q, 0.0), (target.quaternion, horizon))
        if all(cone.clearance(a[None], np.array([t]))[0] > 0.02 for cone in kept for a, t in ends):
            made += 1
            yield f"{craft} {name} {angle:.0f} deg {horizon:.0f} s", replace(task, cones=kept)


def clearance(task: SlewTask, plan: SlewPlan) -> float:
    """Return the smallest angle (rad) between the path and the cones, sampled twice a second."""
    times = np.linspace(0.0, plan.horizon, 2 * int(plan.horizon) + 2)
    turned = np.array([matrix(q) for q in plan.path.references(times).quaternion])
    nearest = np.inf
    for cone in task.cones:
        cosine = np.einsum("i,nij,nj->n", cone.axis, turned, cone.direction(times))
        nearest = min(nearest, float((np.arccos(np.clip(cosine, -1.0, 1.0)) - cone.half_angles(times)).min()))
    return nearest
