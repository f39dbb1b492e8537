"""Star identification in difficult lists.

The lists have an unknown field of view, false stars that are all brighter than the true stars, mirrored
images, an assumed field that is 10 % wrong, or an uncalibrated lens with 2 to 8 % of distortion. Points that
show no part of the sky measure the time of a refusal. The lists are drawn as in the benchmark `starid`.
`wrong` counts incorrect results. For a distorted lens, a result is wrong only if its error exceeds both five
sigmas and 120 arcseconds. The exit status is 1 if a result is wrong. `--peer` runs tetra3rs or cedar-solve on
the same lists.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from ground.campaigns.runner import show
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.startracker.attitude_fit import StarMatch
from knightcube.vision.startracker.index import GuideStars, SkyIndex
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.lost_in_space import identify
from tests.studies.bench.star_peers import PEERS
from tests.studies.bench.starid import ARCSECONDS, Answer, PeerPython, job_of, peer_answers, pointing_error
from tests.studies.command import Json, Seed, command
from tests.support.star_lists import PIXELS, ListKind, StarList, draw, draw_random

_SEED = 314_159
_RIGHT_DEG = 0.05
_SHARE = 0.8
_MISLEADING_SIGMAS, _MISLEADING_ARCSEC = 5.0, 120.0
_DISTORTION = 0.02, 0.08
_HINT = 0.1
_UNKNOWN = ListKind(noise_px=0.3, known_deg=None)
_WIDE = replace(_UNKNOWN, searched_deg=(4.0, 60.0), false_stars=2)
_EVEN = 10.0, 30.0


@dataclass(frozen=True, slots=True)
class Hardship:
    """One row of the table: the kind of the lists, their range of fields of view, and their difficulties.

    Attributes:
        kind: parameters of the lists.
        fields: range of fields of view, deg.
        distorted: whether the lens has a random distortion (_DISTORTION at the corner), and the list 0 to 5
            false stars.
        hint: relative error of the given field of view.
        strewn: whether the points are random and show no part of the sky.
    """

    kind: ListKind
    fields: tuple[float, float] = _EVEN
    distorted: bool = False
    hint: float = 0.0
    strewn: bool = False


def hardships() -> dict[str, Hardship]:
    """Return the rows by name."""
    rows = {
        f"unknown 10-30 deg, {noise} px, 5 false": Hardship(
            replace(_UNKNOWN, noise_px=noise, false_stars=5), fields
        )
        for noise, fields in ((0.3, _EVEN), (0.5, (12.0, 12.0)))
    }
    for count in (3, 5, 10, 20, 40):
        kind = replace(_UNKNOWN, false_stars=count, bright=True)
        rows[f"unknown 10-30 deg, {count} bright false"] = Hardship(kind)
    rows["unknown 4-60 deg, of 4-10 deg to V 8"] = Hardship(replace(_WIDE, faintest=8.0), (4.0, 10.0))
    rows["unknown 4-60 deg, of 10-30 deg"] = Hardship(_WIDE)
    rows["unknown 4-60 deg, of 30-60 deg to V 5"] = Hardship(replace(_WIDE, faintest=5.0), (30.0, 60.0))
    for name, known in (("known", 0.1), ("unknown 10-30 deg", None)):
        rows[f"{name}, mirrored"] = Hardship(replace(_UNKNOWN, known_deg=known, false_stars=2, mirrored=True))
    rows["known to 5 %, hint 10 % wrong"] = Hardship(
        replace(_UNKNOWN, known_deg=0.6, false_stars=2), (12.0, 12.0), hint=_HINT
    )
    for name, known in (("known", 0.1), ("known to 1 deg", 1.0), ("unknown 10-30 deg", None)):
        rows[f"{name}, distorted 2-8 %"] = Hardship(replace(_UNKNOWN, known_deg=known), distorted=True)
    for name, kind in (("known", replace(_UNKNOWN, known_deg=0.1)), ("unknown", _UNKNOWN), ("4-60", _WIDE)):
        rows[f"random, {name}"] = Hardship(kind, strewn=True)
    return rows


def drawn_list(row: Hardship, stars: GuideStars, rng: np.random.Generator) -> StarList:
    """Return one list of a row."""
    kind = replace(row.kind, field_deg=float(rng.uniform(*row.fields)))
    if row.strewn:
        return draw_random(row.kind, int(rng.integers(4, 41)), rng)
    if row.distorted:
        shift = float(rng.uniform(*_DISTORTION) * rng.choice([-1.0, 1.0]))
        kind = replace(kind, distortion_px=shift * PIXELS / np.sqrt(2.0), false_stars=int(rng.integers(0, 6)))
    return draw(kind, stars, rng)


def answered(row: Hardship, drawn: StarList, sky: SkyIndex) -> tuple[StarMatch, float]:
    """Return the result of this project's method, and its time (ms)."""
    field = drawn.field()
    if row.hint:
        field = replace(field.rescaled(1.0 + row.hint), scale=field.scale)
    begin = time.process_time()
    found = identify(field, sky)
    return found, 1000.0 * (time.process_time() - begin)


def verdict(row: Hardship, drawn: StarList, found: StarMatch) -> str:
    """Return "right", "wrong" or "refused"."""
    if found.fix is None:
        return "refused"
    matched = found.star >= 0
    named = float(np.mean(found.star[matched] == drawn.star[matched]))
    if row.strewn or named < _SHARE or found.mirrored != drawn.kind.mirrored:
        return "wrong"
    turn = attitude_matrix(found.fix.quaternion) @ attitude_matrix(drawn.attitude).T
    error = 0.5 * np.array([turn[1, 2] - turn[2, 1], turn[2, 0] - turn[0, 2]])
    off = float(np.linalg.norm(error))
    if not row.distorted:
        return "right" if off < np.deg2rad(_RIGHT_DEG) else "wrong"
    sigmas = float(np.sqrt(error @ np.linalg.solve(found.fix.covariance[:2, :2], error)))
    misleads = sigmas > _MISLEADING_SIGMAS and off * ARCSECONDS > _MISLEADING_ARCSEC
    return "wrong" if misleads else "right"


def measured(
    name: str, lists: int, sky: SkyIndex, seed: int, peer: str | None = None, python: str = sys.executable
) -> dict[str, Any]:
    """Return the results of one row of the table."""
    row, number = hardships()[name], list(hardships()).index(name)
    drawn = [
        drawn_list(row, sky.stars, np.random.default_rng([seed, number, place])) for place in range(lists)
    ]
    answered(row, drawn[0], sky)
    answers = [answered(row, one, sky) for one in drawn]
    verdicts = [verdict(row, one, found) for one, (found, _) in zip(drawn, answers, strict=True)]
    ms = [spent for _, spent in answers]
    figures = {
        "row": name,
        "lists": lists,
        **{kind: verdicts.count(kind) for kind in ("right", "wrong", "refused")},
        "median_ms": float(np.median(ms)),
        "p95_ms": float(np.percentile(ms, 95)),
        "max_ms": max(ms),
    }
    # Another program may use its whole time limit for a list of random positions.
    if peer is None or row.strewn:
        return figures
    theirs = peer_answers(peer, python, [job_of(one, row.hint) for one in drawn])
    return figures | ({} if theirs is None else {"peer_right": _right(theirs[0], drawn)})


def _right(answers: Sequence[Answer], drawn: Sequence[StarList]) -> int:
    limit = np.deg2rad(_RIGHT_DEG)
    return sum(
        answer.boresight is not None and bool(np.any(one.star >= 0)) and pointing_error(answer, one) < limit
        for answer, one in zip(answers, drawn, strict=True)
    )


@command
def main(
    *,
    lists: Annotated[int, "of each row"] = 100,
    only: Annotated[str, "rows whose names contain it"] = "",
    seed: Seed = _SEED,
    peer: Annotated[str | None, "another program on the same lists", tuple(PEERS)] = None,
    peer_python: PeerPython = sys.executable,
    json: Json = False,
) -> int:
    """Print the table. Returns 1 if a result is wrong."""
    sky = default_index()
    rows = [measured(name, lists, sky, seed, peer, peer_python) for name in hardships() if only in name]
    show({"rows": rows}, json)
    return int(any(row["wrong"] for row in rows))
