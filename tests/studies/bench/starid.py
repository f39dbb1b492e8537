"""Star identification compared with cedar-solve and tetra3rs.

The lists have the twelve configurations of issue 4: 1024 x 1024 pixels, fields of 12 and 20 deg, 0.1 and 0.5
px of noise, and 0, 2 and 5 false stars. Their assumed field is wrong by up to 0.1 deg. Further lists have an
unknown field between 10 and 30 deg, or show no part of the sky. A result is correct if its boresight is
correct to 0.05 deg and 80 % of the identified stars are correct. Times are processor times of one core with
one list per call. The other programs run in separate processes.

`bound` is the median, over the lists, of the pointing error divided by the median error that the centroid
noise allows. This median error follows from the Fisher information of all true stars of the list for unknown
attitude and scale. It is 1.1774 sigma, the median of a Rayleigh distribution.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ground.campaigns.runner import show
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.startracker.attitude_fit import MatchStatus, refine
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.lost_in_space import identify
from tests.studies.command import Json, Seed, command
from tests.support.star_lists import (
    PIXELS,
    ListKind,
    StarList,
    believed_field,
    configurations,
    draw,
    draw_random,
)

_SEED = 271_828
_RIGHT_DEG = 0.05
_SHARE = 0.8
_PEERS_RANDOM = 20
_RAYLEIGH = 1.1774
ARCSECONDS = 3600.0 * 180.0 / np.pi
Peers = Annotated[bool, "also run cedar-solve and tetra3rs"]
PeerPython = Annotated[str, "Python interpreter that has the other programs"]
_INSTALL = (
    "give --peer-python the Python of an environment with them: pip install cedar-solve tetra3rs"
    " (cedar-solve wants numpy below 2, so an environment of their own)"
)


@dataclass(frozen=True, slots=True)
class Answer:
    """Result of one solver: time (ms), boresight (3,) or None, fraction of correct identifications."""

    ms: float
    boresight: FloatArray | None
    named: float = 1.0


def our_answers(lists: Sequence[StarList], sky: SkyIndex) -> list[Answer]:
    """Return the results of this project's default method."""
    answers = []
    for drawn in lists:
        field = drawn.field()
        begin = time.process_time()
        found = identify(field, sky)
        ms = 1000.0 * (time.process_time() - begin)
        if found.status is not MatchStatus.IDENTIFIED or found.fix is None:
            answers.append(Answer(ms, None))
            continue
        matched = found.star >= 0
        named = float(np.mean(found.star[matched] == drawn.star[matched]))
        answers.append(Answer(ms, attitude_matrix(found.fix.quaternion)[2], named))
    return answers


def peer_answers(peer: str, python: str, jobs: Sequence[dict[str, Any]]) -> tuple[list[Answer], float] | None:
    """Return another program's results for jobs in the format of `star_peers`, and its resident memory (MB).

    Returns None if the program is not installed.
    """
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump(jobs, file)
        file.flush()
        worker = Path(__file__).with_name("star_peers.py")
        done = subprocess.run(
            [python, str(worker), peer, file.name],
            capture_output=True,
            text=True,
            env=_one_core(),
            check=False,
        )
    if done.returncode != 0:
        sys.stderr.write(f"{peer}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}; {_INSTALL}\n")
        return None
    said = json.loads(done.stdout)
    answers = [
        Answer(row["ms"], None if row["boresight"] is None else np.array(row["boresight"]))
        for row in said["results"]
    ]
    return answers, float(said["megabytes"])


def job_of(drawn: StarList, hint: float = 0.0) -> dict[str, Any]:
    """Return a list in the format of `star_peers`; `hint` is the relative error of a known field of view."""
    kind = drawn.kind
    if kind.known_deg is None:
        low, high = kind.searched_deg
        field, error = 0.5 * (low + high), 0.5 * (high - low)
    else:
        field, error = believed_field(kind)[0] * (1.0 + hint), kind.known_deg
    pixels = drawn.pixels.copy()
    if kind.mirrored:
        pixels[:, 0] = PIXELS - 1.0 - pixels[:, 0]
    return {"pixels": pixels.tolist(), "size": PIXELS, "field_deg": field, "known_deg": error}


def _one_core() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "RAYON_NUM_THREADS": "1"}


def pointing_error(answer: Answer, drawn: StarList) -> float:
    """Return the angle (rad) between the boresight of a result and the true one."""
    assert answer.boresight is not None
    true = attitude_matrix(drawn.attitude)[2]
    return float(np.arctan2(np.linalg.norm(np.cross(answer.boresight, true)), answer.boresight @ true))


def pointing_bound(drawn: StarList, sky: SkyIndex) -> float:
    """Return the bound of the boresight's sigma (rad) per axis, from all true stars with unknown scale."""
    true = np.flatnonzero(drawn.star >= 0)
    field = drawn.field()
    scale = PIXELS / (2.0 * drawn.camera.focal_length * field.half_width[0])
    best = refine(
        field.direction[true],
        sky.stars.direction[drawn.star[true]],
        field.sigma[true],
        attitude_matrix(drawn.attitude),
        scale,
        True,
    )
    return float("nan") if best is None else float(np.sqrt(0.5 * np.trace(best.covariance[:2, :2])))


def row_of(
    solver: str, kind: str, answers: Sequence[Answer], lists: Sequence[StarList], bounds: Sequence[float]
) -> tuple[dict[str, Any], list[float]]:
    """Return one solver's results on the first lists of one kind, and its errors divided by their bounds."""
    lists, bounds = lists[: len(answers)], bounds[: len(answers)]
    errors = np.array(
        [np.nan if a.boresight is None else pointing_error(a, d) for a, d in zip(answers, lists, strict=True)]
    )
    named = np.array([answer.named for answer in answers])
    sky = np.array([bool(np.any(drawn.star >= 0)) for drawn in lists])
    right = sky & (errors < np.deg2rad(_RIGHT_DEG)) & (named >= _SHARE)
    refused = np.isnan(errors)
    ms = np.array([answer.ms for answer in answers])
    ratio = errors[right] / (_RAYLEIGH * np.array(bounds)[right])
    row = {
        "solver": solver,
        "kind": kind,
        "lists": len(lists),
        "right": int(right.sum()),
        "wrong": int((~right & ~refused).sum()),
        "refused": int(refused.sum()),
        "median_ms": float(np.median(ms)),
        "p95_ms": float(np.percentile(ms, 95)),
        "max_ms": float(ms.max()),
        "error_arcsec": float(np.median(errors[right]) * ARCSECONDS) if right.any() else None,
        "over_bound": float(np.median(ratio)) if right.any() else None,
    }
    return row, ratio.tolist()


def memory_of_index() -> float:
    """Return the memory growth, MB, of a process that loads the index and identifies the stars of a list."""
    script = (
        "import resource, numpy as np\n"
        "from knightcube.vision.startracker.index.build import default_index\n"
        "from knightcube.vision.startracker.attitude_fit import StarField\n"
        "from knightcube.vision.startracker.lost_in_space import identify\n"
        "def now(): return int(open('/proc/self/statm').read().split()[1]) * resource.getpagesize() / 2**20\n"
        "before = now()\n"
        "sky = default_index()\n"
        "xy = np.random.default_rng(1).uniform(-0.1, 0.1, (20, 2))\n"
        "v = np.column_stack([xy, np.ones(20)]); v /= np.linalg.norm(v, axis=1, keepdims=True)\n"
        "identify(StarField(v, np.full(20, 1e-4), (0.1, 0.1), (0.5, 2.0)), sky)\n"
        "print(now() - before)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env=_one_core(), check=True
    )
    return float(done.stdout)


def cases(count: int, sky: SkyIndex, seed: int) -> dict[str, list[StarList]]:
    """Return the lists by the name of their configuration."""
    found = {}
    for number, kind in enumerate(configurations()):
        name = f"{kind.field_deg:.0f} deg, {kind.noise_px} px, {kind.false_stars} false"
        found[name] = [draw(kind, sky.stars, np.random.default_rng([seed, number, i])) for i in range(count)]
    for number, kind in enumerate(configurations(known_deg=None)[:3]):
        rngs = [np.random.default_rng([seed, 100 + number, i]) for i in range(count)]
        name = f"10-30 deg unknown, 0.3 px, {kind.false_stars} false"
        found[name] = [
            draw(replace(kind, noise_px=0.3, field_deg=float(rng.uniform(10.0, 30.0))), sky.stars, rng)
            for rng in rngs
        ]
    for known in (0.1, None):
        kind = ListKind(known_deg=known, noise_px=0.3)
        rngs = [np.random.default_rng([seed, 200, i]) for i in range(5 * count)]
        name = "random, field known" if known else "random, field unknown"
        found[name] = [draw_random(kind, int(rng.integers(4, 41)), rng) for rng in rngs]
    kind = ListKind()
    found["star-less"] = [
        draw_random(kind, i % 4, np.random.default_rng([seed, 300, i])) for i in range(count)
    ]
    return found


def measure(count: int, seed: int, peers: bool, peer_python: str) -> dict[str, Any]:
    """Return all results of the benchmark."""
    sky = default_index()
    everything = cases(count, sky, seed)
    # The first call of each numpy function and the first use of each triangle list take extra time.
    our_answers(everything[next(iter(everything))][:20], sky)
    bounds = {
        name: [pointing_bound(drawn, sky) if np.sum(drawn.star >= 0) > 2 else float("nan") for drawn in lists]
        for name, lists in everything.items()
    }
    answers = {"flight": {name: our_answers(lists, sky) for name, lists in everything.items()}}
    megabytes = {"flight": memory_of_index()}
    # Another program may use its whole time limit for a list that shows no part of the sky.
    shown = {name: lists[: _PEERS_RANDOM if "random" in name else None] for name, lists in everything.items()}
    jobs = [job_of(drawn) for lists in shown.values() for drawn in lists]
    for peer in ("cedar-solve", "tetra3rs") if peers else ():
        if (said := peer_answers(peer, peer_python, jobs)) is not None:
            given, megabytes[peer] = iter(said[0]), said[1]
            answers[peer] = {name: list(islice(given, len(lists))) for name, lists in shown.items()}
    rows = []
    over: dict[str, list[float]] = {solver: [] for solver in answers}
    known = list(everything)[: len(configurations())]
    for solver, own in answers.items():
        for name, found in own.items():
            row, ratios = row_of(solver, name, found, everything[name], bounds[name])
            rows.append(row)
            over[solver] += ratios if name in known else []
    ms = {solver: [each.ms for name in known for each in own[name]] for solver, own in answers.items()}
    return {
        "seed": seed,
        "rows": rows,
        "megabytes": megabytes,
        "over_bound": {solver: float(np.median(found)) for solver, found in over.items() if found},
        "time_over_peer": {
            peer: {
                "median": float(np.median(ms["flight"]) / np.median(spent)),
                "p95": float(np.percentile(ms["flight"], 95) / np.percentile(spent, 95)),
            }
            for peer, spent in ms.items()
            if peer != "flight"
        },
    }


@command
def main(
    *,
    lists: Annotated[int, "of each configuration"] = 200,
    seed: Seed = _SEED,
    peers: Peers = False,
    peer_python: PeerPython = sys.executable,
    json: Json = False,
) -> int:
    """Print the tables. Returns 1 if a list was identified wrongly."""
    figures = measure(lists, seed, peers, peer_python)
    show(figures, json)
    return int(any(row["wrong"] for row in figures["rows"] if row["solver"] == "flight"))
