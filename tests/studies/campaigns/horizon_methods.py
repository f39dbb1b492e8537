"""Campaign `horizon-methods`: the paper's methods and the default methods to find nadir, on the same frames.

Meller et al. leave this evaluation open (chapter 5). Three level cameras 120 deg apart (VT) image the Earth
from altitudes of 380 to 800 km in random illumination. All methods know the lenses, and none knows the
atmosphere. The attitudes are `level` (within 2 deg), `tilted` (within 15 deg, as far as the paper's cameras
keep the horizon in view) or `any`. In `sunlit` scenes the first two cameras show a sunlit limb; in
`terminator` scenes the first camera shows the terminator. The default method and the method of all cameras
together have the prior knowledge of a flight (as in the campaign `nadir`). The methods of the paper know the
altitude; `graphic` also knows the pointing of the cameras. `vector` knows the true nadir half a second
earlier, while the body rotates at up to 2 deg/s. A result is wrong if its error exceeds half a degree, and
far wrong if it exceeds five degrees.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.reference.horizon import (
    GraphicMethodError,
    LevelCamera,
    NoHorizonError,
    circle_nadir,
    graphic_nadir,
    propagated_nadir,
    scan_horizon,
)
from knightcube.vision.camera.lens import MountedCamera
from knightcube.vision.horizon.limb import MEAN_RADIUS
from knightcube.vision.horizon.nadir import find_nadir, nadir_of_cameras
from knightcube.vision.horizon.settings import HorizonKnowledge, SensedDirection
from sim_hal.earth_camera import EarthCameraModel, EarthScene, render
from tests.pace import warm_call
from tests.sim_hal.earth_camera.scenes import DAY, NIGHT, pointing, random_direction
from tests.studies.campaigns.nadir import WRONG_DEG
from tests.support.earth_truth import limb_truth
from tests.support.limb_frames import (
    FIELD_SIGMA,
    SUN_SIGMA,
    camera_model,
    finder_settings,
    misread,
    random_air,
)
from tests.support.orbit_geometry import suite

ATTITUDES = {"level": np.radians(2.0), "tilted": np.radians(15.0), "any": np.pi}
LIGHTS = ("sunlit", "terminator")
METHODS = (
    "default",
    "several cameras",
    "circle, 3 lines",
    "circle, 32 lines",
    "graphic, 3 lines",
    "graphic, 32 lines",
    "vector, 32 lines",
)
FAR_DEG = 5.0
ALTITUDES = 380e3, 800e3
STEP, FASTEST = 0.5, np.radians(2.0)
_LEAST_POINTS = 60
_MOST_DRAWS = 20_000


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` instants of each attitude in each illumination."""
    return [
        Case(f"{attitude}-{light}-{run}", (seed, number, place, run), {"attitude": attitude, "light": light})
        for number, attitude in enumerate(ATTITUDES)
        for place, light in enumerate(LIGHTS)
        for run in range(runs)
    ]


def run(case: Case) -> Result:
    """Run all methods on one instant."""
    generator = np.random.default_rng(case.seed)
    model, cameras = camera_model(), _cameras()
    instant = _draw(case, generator, model, cameras)
    turn = from_rotation_vector(-STEP * FASTEST * generator.uniform() * random_direction(generator))
    before = _scene(instant, multiply(turn, instant["attitude"]), cameras[0])
    frames = [render(model, _scene(instant, instant["attitude"], one), generator) for one in cameras]
    earlier = render(model, before, generator)
    body = attitude_matrix(instant["attitude"])
    position, sun, field = instant["position"], instant["sun"], random_direction(generator)
    knowledge = HorizonKnowledge(
        position=position,
        sun=sun,
        sensed=tuple(
            SensedDirection(misread(body @ true, sigma, generator), true, sigma)
            for true, sigma in ((sun, SUN_SIGMA), (field, FIELD_SIGMA))
        ),
    )
    truth = body @ (-position / np.linalg.norm(position))
    known = before.camera_matrix @ (-position / np.linalg.norm(position))
    answers = {}
    for name, ask in _methods(model, cameras, frames, earlier, knowledge, known).items():
        found, spent = warm_call(name, ask)
        off = None if found is None else float(np.degrees(np.arccos(np.clip(found @ truth, -1.0, 1.0))))
        answers[name] = {"error_deg": off, "milliseconds": 1e3 * spent}
    return {**case.parameters, "seed": list(case.seed), "answers": answers}


def _cameras() -> list[MountedCamera]:
    lens = camera_model().lens
    return [MountedCamera(lens, np.array(one.mounting)) for one in suite("vt").cameras]


def _draw(
    case: Case, generator: np.random.Generator, model: EarthCameraModel, cameras: Sequence[MountedCamera]
) -> dict[str, Any]:
    """Return an instant whose first camera has the limb in the illumination of the case.

    If the case is sunlit, the second camera has the sunlit limb too.
    """
    air, widest = random_air(generator), ATTITUDES[case.parameters["attitude"]]
    for _ in range(_MOST_DRAWS):
        position = (SEMI_MAJOR_AXIS + generator.uniform(*ALTITUDES)) * random_direction(generator)
        down = -position / np.linalg.norm(position)
        tilt = generator.uniform() * widest if widest < np.pi else np.arccos(generator.uniform(-1.0, 1.0))
        aside = np.cross(down, random_direction(generator))
        axis = np.cos(tilt) * down + np.sin(tilt) * aside / np.linalg.norm(aside)
        drawn: dict[str, Any] = {
            "position": position,
            "sun": random_direction(generator),
            "attitude": pointing(axis, random_direction(generator)),
            "rotation": generator.uniform(0.0, 2.0 * np.pi),
            "air": air,
        }
        sunlit = case.parameters["light"] == "sunlit"
        if all(_fits(_scene(drawn, drawn["attitude"], one), model, sunlit) for one in cameras[: 1 + sunlit]):
            return drawn
    raise RuntimeError(f"no instant for {case.key} in {_MOST_DRAWS} draws")


def _fits(scene: EarthScene, model: EarthCameraModel, sunlit: bool) -> bool:
    cosines = limb_truth(scene, model, count=720).solar_cosines
    if len(cosines) < _LEAST_POINTS:
        return False
    low, high = float(cosines.min()), float(cosines.max())
    return low > DAY if sunlit else low < NIGHT and high > DAY


def _scene(instant: dict[str, Any], attitude: FloatArray, camera: MountedCamera) -> EarthScene:
    return EarthScene(
        instant["position"],
        multiply(camera.mounting, attitude),
        ASTRONOMICAL_UNIT * instant["sun"],
        rotation=instant["rotation"],
        atmosphere=instant["air"],
    )


def _methods(
    model: EarthCameraModel,
    cameras: Sequence[MountedCamera],
    frames: Sequence[Image],
    earlier: Image,
    knowledge: HorizonKnowledge,
    known: FloatArray,
) -> dict[str, Callable[[], FloatArray | None]]:
    """Return each method as a function that returns nadir (3,) in body axes, or None."""
    settings, first, lens = finder_settings(model), cameras[0], model.lens
    assert knowledge.position is not None
    altitude = float(np.linalg.norm(knowledge.position)) - MEAN_RADIUS
    seen = tuple(
        SensedDirection(first.in_camera(one.camera), one.inertial, one.sigma) for one in knowledge.sensed
    )
    alone = HorizonKnowledge(position=knowledge.position, sun=knowledge.sun, sensed=seen)

    def default() -> FloatArray | None:
        found = find_nadir(frames[0], lens, alone, settings).nadir
        return None if found is None else first.in_body(found.direction)

    def several() -> FloatArray | None:
        found = nadir_of_cameras(dict(enumerate(frames)), cameras, knowledge, settings).nadir
        return None if found is None else found.direction

    def circle(lines: int) -> FloatArray | None:
        try:
            found = scan_horizon(frames[0], lens, lines)
        except NoHorizonError:
            return None
        return first.in_body(circle_nadir(found.circle, lens, altitude))

    def graphic(lines: int) -> FloatArray | None:
        # The camera's x axis points to the right in body axes, and its y axis along body z.
        level = [LevelCamera(one.to_camera[0, :2], lens.ideal.centre) for one in cameras[:2]]
        try:
            one, other = (scan_horizon(frame, lens, lines).circle for frame in frames[:2])
            return graphic_nadir((level[0], level[1]), (one, other), altitude)
        except (NoHorizonError, GraphicMethodError):
            return None

    def vector(lines: int) -> FloatArray | None:
        try:
            before, after = (scan_horizon(frame, lens, lines).middle for frame in (earlier, frames[0]))
        except NoHorizonError:
            return None
        return first.in_body(propagated_nadir(known, before, after))

    return {
        "default": default,
        "several cameras": several,
        "circle, 3 lines": lambda: circle(3),
        "circle, 32 lines": lambda: circle(32),
        "graphic, 3 lines": lambda: graphic(3),
        "graphic, 32 lines": lambda: graphic(32),
        "vector, 32 lines": lambda: vector(32),
    }


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return a table of each method in each illumination and attitude."""
    facts: dict[str, Any] = {}
    for attitude in ATTITUDES:
        for light in LIGHTS:
            mine = [r for r in results if (r["attitude"], r["light"]) == (attitude, light)]
            for method in METHODS if mine else ():
                row = _row([result["answers"][method] for result in mine])
                facts[f"{attitude}/{light}/{method}"] = row
    return summary(facts)


def _row(answers: Sequence[dict[str, Any]]) -> dict[str, Any]:
    errors = np.array([one["error_deg"] for one in answers if one["error_deg"] is not None])
    return {
        "frames": len(answers),
        "answers": len(errors),
        "wrong": int(np.count_nonzero(errors > WRONG_DEG)),
        "far": int(np.count_nonzero(errors > FAR_DEG)),
        "median_deg": float(np.median(errors)) if len(errors) else None,
        "most_deg": float(np.percentile(errors, 95.0)) if len(errors) else None,
        "milliseconds": float(np.median([one["milliseconds"] for one in answers])),
    }


HORIZON_METHODS = Campaign(
    "horizon-methods",
    "nadir by the default method, several cameras, and Meller's circle, Graphic and Vector Methods",
    cases,
    run,
    summarise,
    50,
)
