"""Frames of stars with foregrounds and defects, solved of each: `python -m tests.studies.bench foregrounds`.

Photographs: those of a folder with a `truth.json`, as the bench `sky` takes them. Rendered frames: the
simulator's camera of 12 deg, at rest, or with streaks (`--streaks`). The field is known to 5 %. A frame is
right within 60" of its truth; no lens is given, and a foreground leaves stars on one side of it.
Peers, where they are installed, get the same frames.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.images import read_image
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.startracker.solve import SolveSettings
from tests.knightcube.vision.startracker.frames import sky, sky_frame
from tests.knightcube.vision.startracker.spoilers import SPOILERS, spoilt
from tests.studies.bench.sky import (
    FIELD_SHARE,
    NARROW_DEG,
    PHOTOGRAPHS,
    RIGHT_ARCSEC,
    angle_arcsec,
    believed,
    centre_of,
)
from tests.studies.bench.star_peers import PEERS
from tests.studies.bench.starid import peer_answers

_SEED = 14_009
_EXPOSURE = 0.1


@dataclass(frozen=True, eq=False)
class Scene:
    """A frame with its truth: boresight (3,), field in degrees."""

    source: str
    pixels: Image
    boresight: FloatArray
    field_deg: float


def rendered(frames: int, streak_px: float) -> Iterator[Scene]:
    """Yield random frames of the simulator's camera, with streaks of `streak_px` (0: points)."""
    for number in range(frames):
        scene = sky_frame(np.random.default_rng([_SEED, number]), streak_px, _EXPOSURE)
        boresight = attitude_matrix(scene.attitude)[2]
        yield Scene("streaks" if streak_px else "rendered", scene.pixels, boresight, NARROW_DEG)


def photographed(folder: Path) -> Iterator[Scene]:
    """Yield the photographs of a folder."""
    for name, truth in json.loads((folder / "truth.json").read_text()).items():
        yield Scene("photographs", read_image(folder / name), centre_of(truth), truth["fov"])


def spoilt_scene(scene: Scene, kind: str, number: int) -> Scene:
    """Return the `number`-th scene with the foreground or defect `kind`."""
    rng = np.random.default_rng([_SEED, number, zlib.crc32(kind.encode())])
    return Scene(scene.source, spoilt(scene.pixels, kind, rng), scene.boresight, scene.field_deg)


def found_boresight(scene: Scene) -> FloatArray | None:
    """Return the boresight (3,) that the star tracker finds; None where it refuses."""
    field = scene.field_deg
    camera, scale = believed(scene.pixels, field, field * (1.0 - FIELD_SHARE), field * (1.0 + FIELD_SHARE))
    found = solve_frame(scene.pixels, camera, scale, _EXPOSURE, sky(), SolveSettings())
    return None if found.fix is None else attitude_matrix(found.fix.quaternion)[2]


def _is_right(scene: Scene, boresight: FloatArray) -> bool:
    return angle_arcsec(boresight, scene.boresight) <= RIGHT_ARCSEC


def _of_peer(peer: str, python: str, scenes: Sequence[Scene]) -> list[FloatArray | None] | None:
    with tempfile.TemporaryDirectory() as folder:
        jobs = []
        for number, scene in enumerate(scenes):
            path = Path(folder) / f"{number}.npy"
            np.save(path, scene.pixels)
            field = scene.field_deg
            jobs.append({"image": str(path), "field_deg": field, "known_deg": FIELD_SHARE * field})
        said = peer_answers(peer, python, jobs)
    return None if said is None else [answer.boresight for answer in said[0]]


def rows_of(
    scenes: Sequence[Scene], kinds: Sequence[str], peers: Sequence[str] = (), python: str = sys.executable
) -> list[dict[str, Any]]:
    """Return for every kind and solver how many of `scenes` come out right, wrong and refused."""
    tried = [(kind, spoilt_scene(scene, kind, n)) for kind in kinds for n, scene in enumerate(scenes)]
    answers: dict[str, list[FloatArray | None] | None]
    answers = {"ours": [found_boresight(scene) for _, scene in tried]}
    # A peer makes its data base at every start: it gets all frames at once.
    answers |= {peer: _of_peer(peer, python, [scene for _, scene in tried]) for peer in peers}
    rows = []
    for solver, found in answers.items():
        for kind in kinds if found is not None else ():
            own = [(scene, b) for (k, scene), b in zip(tried, found or (), strict=True) if k == kind]
            judged = [_is_right(scene, b) for scene, b in own if b is not None]
            right = sum(judged)
            rows.append(
                {
                    "source": scenes[0].source,
                    "kind": kind,
                    "solver": solver,
                    "frames": len(own),
                    "right": right,
                    "wrong": len(judged) - right,
                }
            )
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; exit status 0."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.bench foregrounds", description=__doc__)
    parser.add_argument("--frames", type=int, default=10, help="rendered ones (default %(default)s)")
    parser.add_argument(
        "--streaks", type=float, metavar="PX", help="rendered frames of streaks, nothing else"
    )
    parser.add_argument("--photographs", type=Path, default=PHOTOGRAPHS, metavar="FOLDER")
    parser.add_argument("--kinds", nargs="+", choices=SPOILERS, default=list(SPOILERS), metavar="KIND")
    parser.add_argument("--peers", action="store_true", help="cedar-solve and tetra3rs on the same frames")
    parser.add_argument(
        "--peer-python", default=sys.executable, metavar="PYTHON", help="that the peers are in"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    peers = list(PEERS) if options.peers else []
    sets = [list(rendered(options.frames, options.streaks or 0.0))]
    if not options.streaks and (options.photographs / "truth.json").is_file():
        sets.append(list(photographed(options.photographs)))
    rows = [row for scenes in sets for row in rows_of(scenes, options.kinds, peers, options.peer_python)]
    sys.stdout.write(json.dumps({"rows": rows}) + "\n" if options.json else _table(rows))
    return 0


def _table(rows: Sequence[dict[str, Any]]) -> str:
    solvers = list(dict.fromkeys(row["solver"] for row in rows))
    lines = [f"{'right + wrong of':16s} {'':14s} {'frames':>6s} " + " ".join(f"{s:>22s}" for s in solvers)]
    for source, kind in dict.fromkeys((row["source"], row["kind"]) for row in rows):
        own = {row["solver"]: row for row in rows if (row["source"], row["kind"]) == (source, kind)}
        figures = [f"{own[s]['right']:d} + {own[s]['wrong']:d}" if s in own else "" for s in solvers]
        frames = next(iter(own.values()))["frames"]
        lines.append(f"{source:16s} {kind:14s} {frames:6d} " + " ".join(f"{text:>22s}" for text in figures))
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
