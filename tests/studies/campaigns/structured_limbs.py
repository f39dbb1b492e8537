"""Campaign `structured-limbs`: sunlit limbs behind the spacecraft's structure, with a wrong field of view.

A boom, panel or edge of random shape and brightness (dark, grey, or lit and textured) covers 5 to 20 % of the
frame and at most half of the visible limb. The mask is `configured` as a polygon, `learned` from 30 earlier
frames of the same camera at random attitudes, or `none`. The error of the focal length is normally
distributed with a standard deviation of 5 %, which is stated as its uncertainty. Altitudes, atmosphere and
cameras are those of the campaign `nadir`. The kind `real` is the photograph of OPS-SAT, rotated and mirrored;
its truth is the limb found without structure.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.vision.camera.images import read_image
from knightcube.vision.camera.lens import CameraModel, Pinhole
from knightcube.vision.horizon.nadir import HorizonSolution, find_nadir, nadir_of_uncertain_field
from knightcube.vision.horizon.settings import HorizonKnowledge, HorizonSettings
from knightcube.vision.horizon_camera_job import StructureMap, polygon_mask
from sim_hal.earth_camera import EarthScene, nadir, render
from tests.sim_hal.earth_camera.scenes import random_scene
from tests.studies.campaigns.limbless import spectral_noise
from tests.support.earth_truth import limb_truth
from tests.support.limb_frames import camera_model, coarse_knowledge, finder_settings, random_air

MASKS = ("configured", "learned", "none")
KNOWN = ("nothing", "altitude", "flight")
FIELD_SIGMA = 0.05
EARLIER = 30
"""Number of earlier frames from which a mask is learned."""
PHOTOGRAPH = Path(__file__).resolve().parents[4] / "shared/data/limb/opssat1_2020-08-16T062350.png"
PHOTOGRAPH_FIELD, PHOTOGRAPH_ALTITUDE = np.radians(12.8), 515e3


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` rendered limbs with each kind of mask, and a quarter as many of the photograph."""
    rendered = [
        Case(f"{mask}-{run}", (seed, number, run), {"kind": "rendered", "mask": mask})
        for number, mask in enumerate(MASKS)
        for run in range(runs)
    ]
    if not PHOTOGRAPH.exists():
        return rendered
    return rendered + [
        Case(f"real-{run}", (seed, len(MASKS), run), {"kind": "real", "mask": "configured"})
        for run in range(max(1, runs // 4))
    ]


def run(case: Case) -> Result:
    """Search one limb with each kind of mask and prior knowledge."""
    generator = np.random.default_rng(case.seed)
    search = _photograph if case.parameters["kind"] == "real" else _rendered
    return {**case.parameters, "seed": list(case.seed), **search(case.parameters["mask"], generator)}


def structure(size: tuple[int, int], generator: np.random.Generator) -> BoolArray:
    """Return the mask (rows, columns) of a structure that covers 5 to 20 % of the frame."""
    rows, columns = size
    while True:
        corners = _corners(generator) * [columns, rows]
        mask = polygon_mask(rows, columns, [[(float(x), float(y)) for x, y in corners]])
        if 0.05 < np.mean(mask) < 0.2:
            return mask


def _corners(generator: np.random.Generator) -> FloatArray:
    """Return corners (n, 2) of a panel, a boom or an edge, relative to the frame, from a random side."""
    low, high = np.sort(generator.uniform(-0.2, 1.2, 2))
    deep, slope = generator.uniform(0.1, 0.9), generator.uniform(-0.3, 0.3)
    ends = (low + slope, high + slope * generator.uniform(0.0, 1.0))
    far = deep * generator.uniform(0.5, 1.0)
    corners = np.array([[low, -0.05], [high, -0.05], [ends[1], deep], [ends[0], far]])
    turned = corners[:, ::-1] if generator.random() < 0.5 else corners
    return np.asarray(1.0 - turned if generator.random() < 0.5 else turned)


def levels_of(frame: Image) -> tuple[float, float]:
    """Return the counts of dark and of bright pixels of a frame."""
    low, high = np.quantile(frame, [0.02, 0.98])
    return float(low), float(high)


def covered(frame: Image, mask: BoolArray, look: tuple[str, int], levels: tuple[float, float]) -> Image:
    """Return the frame with a structure of constant brightness.

    `look` is the kind of the structure and the seed of its surface; `levels` are the counts of dark and of
    bright pixels.
    """
    (kind, seed), (low, high) = look, levels
    generator = np.random.default_rng(seed)
    level = {"dark": 0.0, "grey": generator.uniform(0.1, 0.5), "lit": generator.uniform(0.5, 1.2)}[kind]
    texture = 0.0 if kind == "dark" else 0.1 * spectral_noise(frame.shape, 1.2, generator)
    light = low + (high - low) * level * (1.0 + texture)
    draw = np.random.default_rng(zlib.crc32(frame.tobytes()))
    light = light + draw.standard_normal(frame.shape)
    top = np.iinfo(frame.dtype).max
    return np.where(mask, np.clip(np.rint(light), 0, top).astype(frame.dtype), frame)


@lru_cache(maxsize=1)
def _earlier_frames() -> list[Image]:
    """Return frames of random scenes with a sunlit limb, from which a mask is learned."""
    model, generator = camera_model(), np.random.default_rng(EARLIER)
    scenes = [random_scene(generator, model, "sunlit") for _ in range(EARLIER)]
    return [render(model, scene, generator) for scene in scenes]


def _rendered(kind: str, generator: np.random.Generator) -> Result:
    model = camera_model()
    mask = structure((model.rows, model.columns), generator)

    def accepted(scene: EarthScene) -> bool:
        points = np.rint(limb_truth(scene, model, count=360).points).astype(int)
        x, y = np.clip(points, 0, [model.columns - 1, model.rows - 1]).T
        return float(np.mean(mask[y, x])) < 0.5

    scene = random_scene(generator, model, "sunlit", accept=accepted)
    scene = replace(scene, atmosphere=random_air(generator))
    look = str(generator.choice(["dark", "grey", "lit"])), int(generator.integers(1 << 30))
    bare = render(model, scene, generator)
    levels = levels_of(bare)
    frame = covered(bare, mask, look, levels)
    hidden, hit = (mask if kind == "configured" else None), None
    if kind == "learned":
        learned = StructureMap.of(np.zeros_like(mask))
        for earlier in _earlier_frames():
            learned = learned.after(covered(earlier, mask, look, levels))
        hidden = learned.after(frame).mask
        found = np.zeros_like(mask) if hidden is None else hidden
        hit = [float(np.mean(found[mask])), float(np.mean(found[~mask]))]
    lens = model.lens.rescaled(float(np.exp(FIELD_SIGMA * generator.standard_normal())))
    truth, height = nadir(scene), float(np.linalg.norm(scene.position)) - 6_371e3
    known = {"nothing": HorizonKnowledge(), "altitude": HorizonKnowledge(altitude=height)}
    known["flight"] = coarse_knowledge(scene, generator)
    settings = finder_settings(model)
    answers = [_answer(name, _search(frame, lens, known[name], settings, hidden), truth) for name in KNOWN]
    return {"look": look[0], "share": float(np.mean(mask)), "hit": hit, "answers": answers}


def _search(
    frame: Image,
    lens: CameraModel,
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
    hidden: BoolArray | None,
) -> HorizonSolution:
    return nadir_of_uncertain_field(frame, lens, FIELD_SIGMA, knowledge, settings, hidden)


def _answer(known: str, found: HorizonSolution, truth: FloatArray) -> dict[str, Any]:
    answer: dict[str, Any] = {"known": known, "status": found.status.value, "reason": found.reason}
    if found.nadir is None:
        return answer
    error = found.nadir.basis @ truth
    nees = 0.5 * float(error @ np.linalg.solve(found.nadir.tangent_covariance, error))
    off = float(np.degrees(np.arccos(np.clip(found.nadir.direction @ truth, -1.0, 1.0))))
    return {**answer, "error_deg": off, "sigma_deg": float(np.degrees(found.nadir.sigma)), "nees": nees}


def _photograph(_: str, generator: np.random.Generator) -> Result:
    frame = np.rot90(read_image(PHOTOGRAPH), int(generator.integers(4)))
    frame = np.ascontiguousarray(frame[:, ::-1] if generator.random() < 0.5 else frame)
    rows, columns = frame.shape
    # The field of view is stated across the longer side of the photograph.
    lens = Pinhole(columns, rows, 0.5 * max(rows, columns) / np.tan(0.5 * PHOTOGRAPH_FIELD))
    knowledge = HorizonKnowledge(altitude=PHOTOGRAPH_ALTITUDE)
    whole = find_nadir(frame, lens, knowledge)
    assert whole.nadir is not None
    while True:
        mask = structure((rows, columns), generator)
        x, y = np.clip(np.rint(whole.points[whole.on_horizon]).astype(int), 0, [columns - 1, rows - 1]).T
        if np.mean(mask[y, x]) < 0.5:
            break
    look = str(generator.choice(["dark", "grey", "lit"])), int(generator.integers(1 << 30))
    wrong = lens.rescaled(float(np.exp(FIELD_SIGMA * generator.standard_normal())))
    found = _search(covered(frame, mask, look, levels_of(frame)), wrong, knowledge, HorizonSettings(), mask)
    answers = [_answer("altitude", found, whole.nadir.direction)]
    return {"look": look[0], "share": float(np.mean(mask)), "hit": None, "answers": answers}


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the fraction of detected limbs and the NEES, for each mask and prior knowledge."""
    rows = []
    for kind, mask in dict.fromkeys((r["kind"], r["mask"]) for r in results):
        of = [r for r in results if (r["kind"], r["mask"]) == (kind, mask)]
        for known in dict.fromkeys(a["known"] for a in of[0]["answers"]):
            answers = [a for r in of for a in r["answers"] if a["known"] == known]
            found = [a for a in answers if "nees" in a]
            rows.append(
                {
                    "kind": kind,
                    "mask": mask,
                    "known": known,
                    "pictures": len(answers),
                    "found": len(found),
                    "nees": float(np.mean([a["nees"] for a in found])) if found else None,
                    "median_deg": float(np.median([a["error_deg"] for a in found])) if found else None,
                    "beyond_3_sigma": sum(2.0 * a["nees"] > 11.8 for a in found),
                }
            )
    hits = np.array([r["hit"] for r in results if r["hit"] is not None])
    facts: dict[str, Any] = {"rows": rows}
    if len(hits):
        facts |= {"structure_learned": float(hits[:, 0].mean()), "scene_hidden": float(hits[:, 1].mean())}
    return summary(facts)


STRUCTURED_LIMBS = Campaign(
    "structured-limbs",
    "limbs behind the spacecraft's structure, field of view wrong; counts pictures of each mask",
    cases,
    run,
    summarise,
    100,
)
