"""Campaign `object-flights`: objects kept in view by coils alone, with filter, planner and pointing law.

Each craft follows passes of 0.05 to 0.6 deg/s and magnitudes 2 to 6 (`object_chase`). Every second flight has
no sighting for ten seconds. From the first frame in which a track is followed, the object should stay within
the field of view. A linear programme (`least_deviation`) computes the smallest possible deviation of a body
that starts at rest. The body has the control authority that issue 16 states, and a roll rate of at most the
rate at which a flight changes to detumbling.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array, lil_array

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray
from tests.studies.campaigns.object_chase import FASTEST, FIELD, GAP, NEAREST, SIGHTING, ObjectChase
from tests.studies.campaigns.orbit_pointing_flight import CYCLE
from tests.studies.campaigns.statistics import grouped, mean

_SIDES = 16
"""Number of sides of the polygons that replace circles in the linear programme.

One circle limits the deviation, and the other limits the angular acceleration that the coils can cause.

The polygon of the acceleration encloses its circle.
"""


def least_deviation(
    seconds: float,
    directions: FloatArray,
    boresight: FloatArray,
    field: FloatArray,
    authority: float,
    roll: float,
) -> float:
    """Return the smallest achievable value of the largest deviation (rad); instants are `seconds` apart.

    `directions` (n, 3) to the object, the initial `boresight` (3,) of the body at rest, and the magnetic
    `field` (n, 3) are in inertial axes. `authority` is in rad/s^2. `roll` is the fastest rate (rad/s) about
    the boresight.
    """
    axes, count = _carried(directions), len(directions)
    speed = np.gradient(directions, seconds, axis=0)
    own = np.einsum("nij,nj->ni", axes, np.gradient(speed, seconds, axis=0))
    moved = np.einsum("nij,nj->ni", axes, speed)
    turned = _turned(directions, axes, field)
    first = axes[0] @ boresight
    first = first / np.linalg.norm(first) * np.arccos(np.clip(boresight @ directions[0], -1.0, 1.0))
    # Unknowns of each instant: deviation, its rate, roll rate, two angular accelerations. The last unknown is
    # the largest deviation.
    right = np.zeros(5 * count)
    rows = lil_array((5 * count, 7 * count + 1))
    rows[:5, :5] = np.eye(5)
    right[:4] = np.concatenate([first, -moved[0]])
    for n in range(count - 1):
        curve = moved[n] @ moved[n] * np.eye(2) - np.outer(moved[n], moved[n])
        step = np.zeros((5, 14))
        step[:, :5], step[:, 7:12] = -np.eye(5), np.eye(5)
        step[:2, 9:11] = -seconds * np.eye(2)
        step[2:4, :2] = seconds * curve
        step[2:5, 5:7] = -seconds * turned[n]
        rows[5 * (n + 1) : 5 * (n + 2), 7 * n : 7 * n + 14] = step
        right[5 * (n + 1) + 2 : 5 * (n + 1) + 4] = -seconds * own[n]
    bounds, most = _polygons(count, authority)
    cost = np.zeros(7 * count + 1)
    cost[-1] = 1.0
    within = np.full((7 * count + 1, 2), [-np.inf, np.inf])
    within[4:-1:7] = [-roll, roll]
    found = linprog(cost, bounds, most, csr_array(rows), right, bounds=within)
    assert found.status == 0, found.message
    return float(found.fun)


def _polygons(count: int, authority: float) -> tuple[csr_array, FloatArray]:
    """Return the constraints: deviations are at most the largest one, accelerations within the authority."""
    sides = np.arange(_SIDES) * 2.0 * np.pi / _SIDES
    corner = np.stack([np.cos(sides), np.sin(sides)], axis=1)
    bounds, most = lil_array((2 * _SIDES * count, 7 * count + 1)), np.zeros(2 * _SIDES * count)
    for n in range(count):
        top = 2 * _SIDES * n
        bounds[top : top + _SIDES, 7 * n : 7 * n + 2] = corner
        bounds[top : top + _SIDES, 7 * count] = -np.ones((_SIDES, 1))
        bounds[top + _SIDES : top + 2 * _SIDES, 7 * n + 5 : 7 * n + 7] = corner
        most[top + _SIDES : top + 2 * _SIDES] = authority
    return csr_array(bounds), most


def _carried(directions: FloatArray) -> FloatArray:
    """Return two axes (n, 2, 3) normal to each direction, propagated by the shortest rotations."""
    first = np.cross(directions[0], np.eye(3)[int(np.argmin(np.abs(directions[0])))])
    first /= np.linalg.norm(first)
    axes = [np.array([first, np.cross(directions[0], first)])]
    for before, after in itertools.pairwise(directions):
        axes.append(axes[-1] - np.outer(axes[-1] @ after, before + after) / (1.0 + before @ after))
    return np.array(axes)


def _turned(directions: FloatArray, axes: FloatArray, field: FloatArray) -> FloatArray:
    """Return the angular accelerations (n, 3, 2) of the deviation (two components) and of the roll.

    The last index selects one of two orthogonal unit angular accelerations normal to the field.
    """
    found = np.zeros((len(directions), 3, 2))
    for n, (direction, both, strength) in enumerate(zip(directions, axes, field, strict=True)):
        along = strength / np.linalg.norm(strength)
        one = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
        one /= np.linalg.norm(one)
        turns = np.array([one, np.cross(along, one)])
        found[n] = np.vstack([both @ np.cross(turns, direction).T, turns @ direction])
    return found


AUTHORITY = {"knightcube": 0.18, "cubesat_3u": 0.012}
"""Angular acceleration (deg/s^2) that the coils can cause across the field, by craft."""
BANDS = ((0.05, 0.1), (0.1, 0.2), (0.2, 0.35), (0.35, 0.6))
"""Bands of the line of sight's rate (deg/s)."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` passes of each craft in each band of rates."""
    return [
        Case(
            f"{craft}/{low:g}/{run}",
            (seed, run, number),
            {
                "craft": craft,
                "orbit": ("sso", "iss")[run % 2],
                "share": 0.3,
                "band": number,
                "magnitude": tuple(SIGHTING)[(run + number) % len(SIGHTING)],
                "gap": NEAREST - 10.0 if run % 2 else None,
            },
        )
        for run in range(runs)
        for craft in AUTHORITY
        for number, (low, _) in enumerate(BANDS)
    ]


def run(case: Case) -> Result:
    """Fly one pass."""
    wanted, (seed, number, band) = case.parameters, case.seed
    low, high = BANDS[wanted["band"]]
    draw = np.random.default_rng(case.seed).uniform(math.log(low), math.log(high))
    chase = ObjectChase({**wanted, "rate_deg": math.exp(draw)}, (seed * 1_009 + number) * 11 + band)
    chase.fly()
    notes = np.array(chase.notes)
    result: Result = {
        **wanted,
        "rate_deg": math.exp(draw),
        "events": chase.reported,
        "refused": chase.refused,
    }
    followed = np.flatnonzero(notes[:, 4] > 0)
    if not len(followed):
        return {**result, "found": None}
    begin = int(followed[0])
    times, off, roll, rate, tracks, seen = notes[begin:].T
    least = least_deviation(
        CYCLE,
        np.array(chase.directions[begin:]),
        chase.shown[begin],
        np.array(chase.fields[begin:]),
        math.radians(AUTHORITY[wanted["craft"]]),
        FASTEST,
    )
    result |= {
        "found": float(times[0]),
        "least": math.degrees(least),
        "most": math.degrees(float(off.max())),
        "could": bool(least < FIELD),
        "kept": bool(off.max() < FIELD),
        "end": math.degrees(float(off[-1])),
        "out": float(CYCLE * np.sum(off > FIELD)),
        "roll": math.degrees(float(np.abs(roll).max())),
        "rate": math.degrees(float(rate.max())),
        "tracks": len(set(tracks[tracks > 0].tolist())),
    }
    if wanted["gap"] is not None and times[0] < wanted["gap"]:
        again = times[(times >= wanted["gap"] + GAP) & (seen > 0.0)]
        held = tracks[times < wanted["gap"]][-1]
        result["again"] = float(again[0] - wanted["gap"]) if len(again) and tracks[-1] == held else None
        result["same"] = bool(held in tracks[times > wanted["gap"] + GAP + 2.0 * CYCLE])
    return result


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return a row for each craft and band."""
    rows: dict[str, Result] = {}
    for name, mine in grouped(results, "craft", "band").items():
        found = [r for r in mine if r["found"] is not None]
        if not found:
            continue
        could, others = [r for r in found if r["could"]], [r for r in found if not r["could"]]
        lost = [r for r in found if "same" in r]
        low, high = BANDS[mine[0]["band"]]
        row: Result = {"low": low, "high": high, "flights": len(mine)}
        row |= {"found": len(found), "could": len(could), "others": len(others)}
        row |= {"kept": sum(r["kept"] for r in could), "kept_others": sum(r["kept"] for r in others)}
        row |= {"out": mean([r["out"] for r in could])}
        row |= {name: float(np.median([r[name] for r in found])) for name in ("least", "most")}
        row |= {"roll": max(r["roll"] for r in found), "rate": max(r["rate"] for r in found)}
        row |= {"lost": len(lost), "again": sum(r["same"] for r in lost)}
        rows[name] = row
    return summary({"rows": rows})
