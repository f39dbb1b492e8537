"""Campaign `warped-photographs`: stretched, sheared or tangentially distorted photographs of the sky.

Each photograph of ../shared/data/sky is warped about its centre by 1 to 4 %: `stretch` along the columns or
the rows, `shear`, or `tangential` distortion (displacement of a corner relative to its distance). In the
cases `all`, each of the three deformations has half that amplitude. The truth is the attitude found in the
original photograph, whose uncertainty is added to the claimed one.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from knightcube.astro.arrays import Image
from knightcube.astro.quaternion import conjugate, multiply, to_rotation_vector
from knightcube.vision.camera.images import read_image
from knightcube.vision.star_tracker import StarSolution, StarTracker

PHOTOGRAPHS = Path(__file__).resolve().parents[4] / "shared/data/sky"
KINDS = ("stretch", "shear", "tangential", "all")
LEAST, MOST = 0.01, 0.04
_FIELD_DEG = 10.8
"""Field of view (deg) of photographs whose field of view is not known."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` warps of each kind of each photograph; without ../shared/data/sky, no case."""
    names = sorted(each.name for each in PHOTOGRAPHS.glob("*.*") if each.suffix not in (".json", ".md"))
    return [
        Case(f"{name}-{kind}-{run}", (seed, place, number, run), {"name": name, "kind": kind})
        for place, name in enumerate(names)
        for number, kind in enumerate(KINDS)
        for run in range(runs)
    ]


def warped(pixels: Image, stretch: float, shear: float, tangential: tuple[float, float]) -> Image:
    """Return an image (rows, columns) after stretching, shear and tangential distortion about its centre."""
    rows, columns = pixels.shape
    y, x = np.mgrid[:rows, :columns].astype(float)
    half = 0.5 * np.hypot(rows, columns)
    u, v = (x - 0.5 * (columns - 1)) / half, (y - 0.5 * (rows - 1)) / half
    p1, p2 = tangential
    right = max(stretch, 0.0) * u + shear * v + p2 * (3.0 * u * u + v * v) + 2.0 * p1 * u * v
    down = max(-stretch, 0.0) * v + shear * u + p1 * (3.0 * v * v + u * u) + 2.0 * p2 * u * v
    places = [y + half * down, x + half * right]
    moved = map_coordinates(pixels.astype(float), places, order=1, mode="nearest")
    return np.asarray(moved.astype(pixels.dtype))


@lru_cache(maxsize=2)
def _plain(name: str) -> tuple[Image, float, StarSolution]:
    """Return a photograph, its field of view in degrees, and its solution."""
    truth = json.loads((PHOTOGRAPHS / "truth.json").read_text(encoding="utf-8")).get(name, {})
    field = float(truth.get("fov", _FIELD_DEG))
    pixels = read_image(PHOTOGRAPHS / name)
    return pixels, field, StarTracker(field).solve(pixels)


def run(case: Case) -> Result:
    """Solve one warped photograph."""
    generator = np.random.default_rng(case.seed)
    name, kind = case.parameters["name"], case.parameters["kind"]
    pixels, field, plain = _plain(name)
    sizes = generator.uniform(LEAST, MOST, 3) * generator.choice([-1.0, 1.0], 3)
    sizes *= 0.5 if kind == "all" else np.array([kind == each for each in KINDS[:3]])
    turn = generator.uniform(0.0, 2.0 * np.pi)
    # A corner along the direction of the distortion is displaced by three times the coefficient.
    tangential = sizes[2] / 3.0 * np.cos(turn), sizes[2] / 3.0 * np.sin(turn)
    result: Result = {"name": name, "kind": kind, "seed": list(case.seed), "size": float(np.abs(sizes).max())}
    if not plain:
        return {**result, "verdict": "not solved unwarped", "sigmas": None}
    found = StarTracker(field).solve(warped(pixels, sizes[0], 0.5 * sizes[1], tangential))
    if not found:
        return {**result, "verdict": "refused", "sigmas": None}
    off = to_rotation_vector(multiply(found.quaternion, conjugate(plain.quaternion)))
    spread = np.sqrt(np.diag(found.covariance + plain.covariance))
    sigmas = float(np.max(np.abs(off) / spread))
    verdict = "right" if sigmas < 3.0 else "beyond 3 sigma"
    return {**result, "verdict": verdict, "sigmas": sigmas}


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return how often warped photographs of each kind are solved within their claimed uncertainty."""
    rows = []
    for kind in dict.fromkeys(r["kind"] for r in results):
        of = [r for r in results if r["kind"] == kind]
        sigmas = [r["sigmas"] for r in of if r["sigmas"] is not None]
        counts = {
            verdict: sum(r["verdict"] == verdict for r in of)
            for verdict in ("right", "beyond 3 sigma", "refused", "not solved unwarped")
        }
        rows.append({"kind": kind, "pictures": len(of), **counts, "worst": max(sigmas, default=None)})
    beyond = [r for r in results if r["verdict"] == "beyond 3 sigma"]
    return summary({"rows": rows, "beyond": [[r["name"], r["kind"], r["sigmas"]] for r in beyond]})


WARPED_PHOTOGRAPHS = Campaign(
    "warped-photographs",
    "photographs stretched, sheared or distorted by 1 to 4 %; counts warps of each kind and photograph",
    cases,
    run,
    summarise,
    2,
)
