"""Campaign `object-flights`: objects kept in the field by coils alone, with filter, planner and law.

Each craft follows passes of 0.05 to 0.6 deg/s and magnitudes 2 to 6 (`object_chase`); every other flight does
not see the object for ten seconds. From the frame on in which a track is followed the object is to stay
within the field. Whether a body at rest there could have kept it, with the authority that issue 16 states,
and no more roll than the rate at which it is braked, is judged by a linear programme (`object_authority`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary
from tests.studies.campaigns.object_authority import least_deviation
from tests.studies.campaigns.object_chase import FASTEST, FIELD, GAP, NEAREST, SIGHTING, ObjectChase
from tests.studies.campaigns.orbit_pointing_flight import CYCLE

AUTHORITY = {"knightcube": 0.18, "cubesat_3u": 0.012}
"""deg/s^2 across the field."""
BANDS = ((0.05, 0.1), (0.1, 0.2), (0.2, 0.35), (0.35, 0.6))
"""deg/s."""


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
    result: Result = {**wanted, "rate_deg": math.exp(draw), "events": chase.told, "refused": chase.refused}
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
    lines = [
        "craft, deg/s            flights found  could  kept of those  kept of others  out s  "
        "deg off: bound, flown  roll deg/s  lost 10 s: kept"
    ]
    facts: Result = {"rows": []}
    for craft in AUTHORITY:
        for number, (low, high) in enumerate(BANDS):
            mine = [r for r in results if r["craft"] == craft and r["band"] == number]
            found = [r for r in mine if r["found"] is not None]
            if not found:
                continue
            could, others = [r for r in found if r["could"]], [r for r in found if not r["could"]]
            lost = [r for r in found if "same" in r]
            row: Result = {"craft": craft, "low": low, "high": high, "flights": len(mine)}
            row |= {"found": len(found), "could": len(could), "others": len(others)}
            row |= {"kept": sum(r["kept"] for r in could), "kept_others": sum(r["kept"] for r in others)}
            row |= {"out": float(np.mean([r["out"] for r in could])) if could else None}
            row |= {name: float(np.median([r[name] for r in found])) for name in ("least", "most")}
            row |= {"roll": max(r["roll"] for r in found), "rate": max(r["rate"] for r in found)}
            row |= {"lost": len(lost), "again": sum(r["same"] for r in lost)}
            facts["rows"].append(row)
            out = "-" if row["out"] is None else f"{row['out']:.0f}"
            lines.append(
                f"{craft:11} {low:4.2f} to {high:4.2f}  {len(mine):5d} {len(found):5d}  {len(could):5d}  "
                f"{row['kept']:13d}  {row['kept_others']:7d} of {len(others)}  {out:>8}  "
                f"{row['least']:10.1f}, {row['most']:5.1f}  {row['roll']:9.2f}  "
                f"{row['again']:8d} of {len(lost)}"
            )
    return Summary("\n".join(lines) + "\n", facts)


OBJECT_FLIGHTS = Campaign(
    "object-flights",
    "objects found and kept in the field by coils alone, beside what authority allows",
    cases,
    run,
    summarise,
    10,
)
