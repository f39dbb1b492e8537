"""Campaign `lost-in-space`: all methods of star identification, with one varied parameter at a time.

Michalski's thesis proposes this survey. The nominal list has a field of 15 deg, centroid noise of 0.3 px, 2
false stars, 10 % missing stars and magnitude errors of 0.2 mag. Each of these parameters is varied alone; the
field of view is known. All methods solve the same lists. A result is right if its boresight is correct to
0.05 deg and at least four in five of the identified stars are correct. All other results are wrong. Times are
processor times. The method `rate` also receives the points' velocities for a rotation of 1 deg/s, observed
for 0.5 s. Half of the false points are at rest on the detector; the other half have random velocities.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.quaternion import attitude_matrix
from knightcube.reference.star_identification import METHODS, StarMotion, identify_by_rate
from knightcube.reference.star_tables import KnownSky, angles
from knightcube.vision.startracker.attitude_fit import MatchStatus, StarField, StarMatch
from knightcube.vision.startracker.index.build import default_index
from tests.pace import warm_call
from tests.studies.campaigns.statistics import median
from tests.support.star_lists import PIXELS, ListKind, StarList, draw

NOMINAL: dict[str, float] = {
    "noise_px": 0.3,
    "false_stars": 2,
    "lost": 0.1,
    "field_deg": 15.0,
    "magnitude_error": 0.2,
}
AXES: dict[str, tuple[float, ...]] = {
    "noise_px": (0.05, 0.1, 0.3, 0.5, 1.0, 2.0),
    "false_stars": (0, 2, 5, 10),
    "lost": (0.0, 0.1, 0.2, 0.3, 0.5),
    "field_deg": (8.0, 10.0, 12.0, 15.0, 20.0, 25.0, 30.0),
    "magnitude_error": (0.0, 0.2, 0.4, 0.7, 1.0),
}
_RIGHT_DEG = 0.05
_RIGHT_SHARE = 0.8
BODY_RATE = float(np.deg2rad(1.0))
EXPOSURE = 0.5


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` lists of each cell; the nominal cell occurs once, without an axis."""
    cells: list[tuple[str, float, int]] = [("nominal", 0.0, 0)]
    for number, (axis, values) in enumerate(AXES.items()):
        cells += [
            (axis, value, 100 * (number + 1) + place)
            for place, value in enumerate(values)
            if value != NOMINAL[axis]
        ]
    return [
        Case(f"{axis}/{value:g}/{run}", (seed, cell, run), {"axis": axis, "value": value})
        for run in range(runs)
        for axis, value, cell in cells
    ]


def run(case: Case) -> Result:
    """Solve one list by every method."""
    axis, value = case.parameters["axis"], case.parameters["value"]
    setting = {**NOMINAL, axis: value} if axis in NOMINAL else NOMINAL
    sky = known_sky(setting["field_deg"])
    kind = ListKind(
        field_deg=setting["field_deg"],
        noise_px=setting["noise_px"],
        false_stars=int(setting["false_stars"]),
        faintest=float(sky.stars.magnitude[-1]),
        magnitude_error=setting["magnitude_error"],
        lost=setting["lost"],
        known_deg=0.0,
    )
    generator = np.random.default_rng(case.seed)
    drawn = draw(kind, sky.index.stars, generator)
    field, motion = drawn.field(), moving(drawn, generator)
    result: Result = {**case.parameters, "stars": len(field)}
    for name in METHODS:
        answer, spent = warm_call(name, partial(answer_of, name, field, sky, motion))
        result[name] = {"verdict": verdict(answer, drawn), "ms": 1000.0 * spent}
    return result


@lru_cache(maxsize=8)
def known_sky(field_deg: float) -> KnownSky:
    """Return the catalogue and tables of the methods for a field of view."""
    half = float(np.tan(np.deg2rad(0.5 * field_deg)))
    sky = KnownSky(default_index(), (half, half))
    for table in ("pairs", "tree", "planar", "spherical", "grid"):
        getattr(sky, table)
    return sky


def answer_of(name: str, field: StarField, sky: KnownSky, motion: StarMotion) -> StarMatch:
    """Give a method all inputs that it can use, and return its result."""
    if name == "rate":
        return identify_by_rate(field, sky, motion=motion)
    return METHODS[name].identify(field, sky)


def moving(drawn: StarList, generator: np.random.Generator) -> StarMotion:
    """Return the velocities of a list's points, as the two ends of their streaks would give them."""
    field = drawn.field()
    axis = generator.standard_normal(3)
    rate = BODY_RATE * axis / np.linalg.norm(axis)
    velocity = np.cross(field.direction, rate)
    false = np.flatnonzero(drawn.star < 0)
    still = false[::2]
    velocity[still] = 0.0
    wild = false[1::2]
    velocity[wild] = np.cross(field.direction[wild], BODY_RATE * generator.standard_normal((len(wild), 3)))
    sigma = np.sqrt(2.0) * field.sigma / EXPOSURE
    return StarMotion(velocity + sigma[:, None] * generator.standard_normal(velocity.shape), sigma)


def verdict(answer: StarMatch, drawn: StarList) -> str:
    """Return "right", "wrong" or "refused" for a result."""
    if answer.status is not MatchStatus.IDENTIFIED or answer.fix is None:
        return "refused"
    true, found = (attitude_matrix(q) for q in (drawn.attitude, answer.fix.quaternion))
    off = float(angles(true[2], found[2]))
    matched = answer.star >= 0
    named = np.mean(answer.star[matched] == drawn.star[matched])
    return "right" if off < np.deg2rad(_RIGHT_DEG) and named >= _RIGHT_SHARE else "wrong"


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the table of all methods by axis, and a figure."""
    cells = [
        {"axis": axis, "value": value, **cell(_results_of(results, axis, value))}
        for axis, values in AXES.items()
        for value in values
    ]
    nominal = cell([r for r in results if r["axis"] == "nominal"])
    facts = {"nominal": {**NOMINAL, **nominal}, "cells": cells, "pixels": PIXELS}
    return summary(facts)


def _results_of(results: Sequence[Result], axis: str, value: float) -> list[Result]:
    wanted = ("nominal", 0.0) if value == NOMINAL[axis] else (axis, value)
    return [r for r in results if (r["axis"], r["value"]) == wanted]


def cell(results: Sequence[Result]) -> dict[str, Any]:
    """Return the counts and times of every method over a set of lists."""
    row: dict[str, Any] = {"lists": len(results)}
    for name in METHODS:
        verdicts = [r[name]["verdict"] for r in results]
        spent = [r[name]["ms"] for r in results]
        row[name] = {
            **{kind: verdicts.count(kind) for kind in ("right", "wrong", "refused")},
            "median_ms": median(spent),
            "p95_ms": float(np.quantile(spent, 0.95)) if spent else None,
        }
    return row
