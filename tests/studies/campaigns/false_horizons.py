"""Campaign `false-horizons`: false detections in images without a limb, and detections of difficult limbs.

Pictures without a limb (`limbless`) are searched by several cameras with three kinds of prior knowledge:
none, the altitude, or that of a flight (position, Sun, coarse Sun and field of a random scene). Any nadir
found in these pictures is a false detection. The campaign also renders difficult limbs: thin crescents,
terminators, a third of the limb behind a structure, sun glint on the sea, the Sun in the frame, and a narrow
camera with linear response. A result for these images is wrong if its error exceeds both half a degree and
five of its claimed standard deviations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from knightcube.astro.arrays import Image
from knightcube.vision.camera.lens import CameraModel, Pinhole
from knightcube.vision.horizon.nadir import find_nadir
from knightcube.vision.horizon.settings import HorizonKnowledge, HorizonSettings
from sim_hal.earth_camera import EarthCameraModel, EarthScene, nadir, render
from tests.sim_hal.earth_camera.scenes import random_scene
from tests.studies.campaigns.limbless import MAKERS, photographed
from tests.support.earth_truth import ideal_counts, limb_truth, radiance_of, sun_point
from tests.support.limb_frames import camera_model, coarse_knowledge, finder_settings

KNOWN = ("nothing", "altitude", "flight")
CAMERAS = ((512, 512, 67.0), (480, 640, 60.0), (768, 1024, 30.0), (768, 1024, 12.8), (512, 512, 100.0))
"""Rows, columns, and horizontal field of view (deg)."""
HARD = ("sunlit", "crescent", "terminator", "hidden", "glint", "glare", "narrow")
ALTITUDE = 515e3
WRONG_DEG, MOST_SIGMAS = 0.5, 5.0
_CRESCENT = 0.05, 0.35
"""Fraction of the visible limb that is lit."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` pictures of each kind without a limb, and a fifth as many of each difficult limb."""
    empty = [
        Case(f"{kind}-{run}", (seed, number, run), {"limb": False, "kind": kind})
        for number, kind in enumerate(MAKERS)
        for run in range(runs)
    ]
    return empty + [
        Case(f"limb-{kind}-{run}", (seed, len(MAKERS) + number, run), {"limb": True, "kind": kind})
        for number, kind in enumerate(HARD)
        for run in range(max(1, runs // 5))
    ]


def run(case: Case) -> Result:
    """Search one picture with each kind of prior knowledge."""
    generator = np.random.default_rng(case.seed)
    search = _limb if case.parameters["limb"] else _empty
    return {**case.parameters, "seed": list(case.seed), "answers": search(case.parameters["kind"], generator)}


def limbless_picture(kind: str, generator: np.random.Generator) -> tuple[Image, CameraModel]:
    """Return a picture without a limb, and the camera that took it."""
    rows, columns, field = CAMERAS[generator.integers(len(CAMERAS))]
    picture = photographed(MAKERS[kind]((rows, columns), generator), generator)
    return picture, Pinhole.from_field_of_view(columns, rows, np.radians(field))


def knowledge_of(scene: EarthScene, known: str, generator: np.random.Generator) -> HorizonKnowledge:
    """Return the prior knowledge of a scene, for one of the kinds in `KNOWN`."""
    if known == "flight":
        return coarse_knowledge(scene, generator)
    height = float(np.linalg.norm(scene.position)) - 6_371e3
    return HorizonKnowledge(altitude=height if known == "altitude" else None)


def _empty(kind: str, generator: np.random.Generator) -> list[Result]:
    picture, camera = limbless_picture(kind, generator)
    elsewhere = random_scene(generator, camera_model(), "sunlit", (ALTITUDE, ALTITUDE))
    answers = []
    for known in KNOWN:
        found = find_nadir(picture, camera, knowledge_of(elsewhere, known, generator))
        verdict = found.status.value if found.nadir is None else "wrong"
        answers.append({"known": known, "verdict": verdict, "edges": int(np.sum(found.on_horizon))})
    return answers


def limb_picture(
    kind: str, generator: np.random.Generator
) -> tuple[Image, EarthScene, EarthCameraModel, HorizonSettings]:
    """Return a limb image of one of the kinds in `HARD`, its scene, its camera and the search settings."""
    if kind == "narrow":
        model, scene = _narrow(generator)
        return render(model, scene, generator), scene, model, HorizonSettings()
    model = camera_model()

    def accepted(scene: EarthScene) -> bool:
        if kind == "glare":
            return bool(model.lens.contains(sun_point(scene, model)[None])[0])
        lit = float(np.mean(limb_truth(scene, model, count=360).solar_cosines > 0.05))
        return kind != "crescent" or _CRESCENT[0] < lit < _CRESCENT[1]

    view = "terminator" if kind in ("crescent", "terminator") else "sunlit"
    scene = random_scene(generator, model, view, accept=accepted)  # type: ignore[arg-type]  # a View
    frame = render(model, scene, generator)
    if kind == "hidden":
        frame = _hidden(frame, scene, model, generator)
    elif kind == "glint":
        frame = _glinting(frame, scene, model, generator)
    return frame, scene, model, finder_settings(model)


def _narrow(generator: np.random.Generator) -> tuple[EarthCameraModel, EarthScene]:
    """Return a narrow camera and a scene; the camera is drawn again if it shows too little of the limb."""
    while True:
        field = np.radians(generator.uniform(15.0, 40.0))
        model = EarthCameraModel.fuga15d(field, seed=1, response="linear", sensitivity=30_000.0)
        try:
            return model, random_scene(generator, model, "sunlit")
        except RuntimeError:
            continue


def _hidden(
    frame: Image, scene: EarthScene, model: EarthCameraModel, generator: np.random.Generator
) -> Image:
    """Return the frame behind a dark structure with a straight edge that covers a third of the limb."""
    points = limb_truth(scene, model, count=720).points
    rows, columns = np.mgrid[0 : model.rows, 0 : model.columns]
    turn = generator.uniform(0.0, 2.0 * np.pi)
    along = np.array([np.cos(turn), np.sin(turn)])
    bound = np.quantile(points @ along, 2.0 / 3.0)
    dark = generator.normal(model.pedestal, 1.0, frame.shape).clip(0, 255).astype(frame.dtype)
    return np.where(columns * along[0] + rows * along[1] > bound, dark, frame)


def _glinting(
    frame: Image, scene: EarthScene, model: EarthCameraModel, generator: np.random.Generator
) -> Image:
    """Return the frame with sun glint on the sea near the limb, with ten times the signal in its centre."""
    points = limb_truth(scene, model, count=720).points
    middle = points[generator.integers(len(points))]
    rows, columns = np.mgrid[0 : model.rows, 0 : model.columns]
    apart = np.hypot(columns - middle[0], rows - middle[1]) / generator.uniform(20.0, 80.0)
    light = np.maximum(radiance_of(model, frame.astype(float)), 0.0) * (1.0 + 9.0 * np.exp(-0.5 * apart**2))
    return np.asarray(np.rint(ideal_counts(model, light)).astype(frame.dtype))


def _limb(kind: str, generator: np.random.Generator) -> list[Result]:
    frame, scene, model, settings = limb_picture(kind, generator)
    truth, answers = nadir(scene), []
    for known in KNOWN:
        found = find_nadir(frame, model.lens, knowledge_of(scene, known, generator), settings)
        answer: dict[str, Any] = {"known": known, "verdict": found.status.value, "reason": found.reason}
        if found.nadir is not None:
            off = float(np.arccos(np.clip(found.nadir.direction @ truth, -1.0, 1.0)))
            right = np.degrees(off) < WRONG_DEG or off < MOST_SIGMAS * found.nadir.sigma
            answer |= {"verdict": "right" if right else "wrong", "error_deg": float(np.degrees(off))}
        answers.append(answer)
    return answers


VERDICTS = ("right", "wrong", "ambiguous", "refused", "no-horizon")


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the frequency of detected horizons for each kind of image and knowledge."""
    rows = []
    for limb, kind in dict.fromkeys((r["limb"], r["kind"]) for r in results):
        of = [r for r in results if (r["limb"], r["kind"]) == (limb, kind)]
        for known in KNOWN:
            counts = Counter(a["verdict"] for r in of for a in r["answers"] if a["known"] == known)
            rows.append({"limb": limb, "kind": kind, "known": known, "pictures": len(of)})
            rows[-1] |= {verdict: counts[verdict] for verdict in VERDICTS}
    wrong = [r["seed"] for r in results if any(a["verdict"] == "wrong" for a in r["answers"])]
    false = sum(any(a["verdict"] == "wrong" for a in r["answers"]) for r in results if not r["limb"])
    empty = sum(not r["limb"] for r in results)
    return summary({"rows": rows, "false": false, "empty": empty, "wrong": wrong})


FALSE_HORIZONS = Campaign(
    "false-horizons",
    "horizons found in pictures without a limb, and hard limbs; counts pictures of each kind",
    cases,
    run,
    summarise,
    50,
)
