"""Tests that each exported name of the public interface exists and is documented."""

from __future__ import annotations

import ast
import builtins
import importlib
import inspect
import math
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from functools import reduce
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import knightcube
from knightcube import (
    ArgumentError,
    Goal,
    KnightCubeError,
    Lens,
    LensCalibration,
    Pinhole,
    PointingTarget,
    SingleAxisPlant,
    StarTracker,
    detect_objects,
    estimate_rate,
    find_nadir,
    plan_step,
)
from knightcube.vision.camera.lens import CameraKnowledge
from knightcube.vision.horizon import settings
from knightcube.vision.horizon.nadir import HorizonSolution, HorizonStatus, NadirMeasurement
from knightcube.vision.objects.detect import DetectedObjects, SpaceObject
from knightcube.vision.objects.settings import ObjectSettings
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.lost_in_space import IdentificationSettings
from knightcube.vision.startracker.solve import SolveSettings
from knightcube.vision.startracker.survey import DetectionSettings
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult, StreakStatus
from knightcube.vision.sun import SunMeasurement, SunSettings, SunSolution, SunStatus

# The type Any permits tests with arguments of wrong types.
LIB: Any = knightcube


def _names_for_type_checkers() -> set[tuple[str, str]]:
    """Return (module, name) of the imports that only type checkers evaluate."""
    tree = ast.parse(Path(knightcube.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    return {
        (str(node.module), alias.name)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name
    }


def test_type_checkers_and_the_interpreter_know_the_same_names() -> None:
    at_run_time = {(inspect.getmodule(getattr(knightcube, name)), name) for name in LIB.__all__}
    assert at_run_time == {
        (importlib.import_module(module), name) for module, name in _names_for_type_checkers()
    }


def test_a_type_checker_knows_all_public_names_and_no_other_name(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        "from knightcube import *\n" + "\n".join(LIB.__all__) + "\nfrom knightcube import StarTrackr\n",
        encoding="utf-8",
    )
    options = "--strict", "--follow-imports=skip", f"--cache-dir={tmp_path}"
    command = [sys.executable, "-m", "mypy", *options, str(program), knightcube.__file__]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    errors = re.findall(': error: (Module "knightcube" has no attribute "StarTrackr")?', done.stdout)
    assert len(errors) == 1, done.stdout + done.stderr
    assert errors[0]


@pytest.mark.parametrize("name", LIB.__all__)
def test_every_public_name_is_documented_with_its_public_methods(name: str) -> None:
    value = getattr(knightcube, name)
    assert name in dir(knightcube)
    assert len(inspect.getdoc(value) or "") > 100
    for member, method in vars(value).items() if inspect.isclass(value) else ():
        if callable(method) and not member.startswith("_"):
            assert inspect.getdoc(method)


@pytest.mark.parametrize("name", LIB.__all__)
def test_every_error_in_a_public_docstring_can_be_caught_by_its_public_name(name: str) -> None:
    """Each error that a public docstring names is exported, and the base class catches all of them."""
    value, parts = getattr(knightcube, name), [getattr(knightcube, name)]
    if inspect.isclass(value):
        parts += [part for member, part in vars(value).items() if callable(part) and member[0] != "_"]
    texts = [inspect.getdoc(part) or "" for part in parts]
    named = {error for text in texts for error in re.findall(r"\b[A-Z]\w*Error\b", text)}
    assert named <= {*LIB.__all__, *dir(builtins)}
    if inspect.isclass(value) and issubclass(value, Exception):
        assert issubclass(value, knightcube.KnightCubeError)


NADIR = NadirMeasurement(np.array([0.6, 0.0, 0.8]), 1e-6 * np.eye(3), 5e5, 1e3, 0.1, used=90)
NONE = np.empty((0, 3))
OBJECT = SpaceObject(
    np.array([[10.0, 30.0], [30.0, 30.0]]), np.ones(2), (), 1e4, 500.0, 0.01, np.array([1.0, 0.0]), 0.1
)
SUN = SunMeasurement(
    np.array([0.6, 0.0, 0.8]), np.eye(3)[:2], 1e-6 * np.eye(2), np.zeros(2), 0.03, 0.1, 6.0, cut=False
)
PLANT = SingleAxisPlant(inertia=1.05e-3, torque_constant=2.9e-4, resistance=23.0, current_limit=0.148)


@pytest.mark.parametrize(
    ("result", "shown"),
    [
        (lambda: StarTracker(fov_deg=10.0).solve(np.zeros((64, 64))), "<StarSolution no-stars: .+>"),
        (lambda: LensCalibration(None, ()), "<LensCalibration of 0 images: no lens was determined>"),
        (
            lambda: MotionResult(
                StreakStatus.RATE, 0, 0.5, rate=np.array([0.1, 0.0, -0.2]), covariance=np.eye(3)
            ),
            r"<MotionResult rate: rate \[0.100000, 0.000000, -0.200000\] \+- 1.7 rad/s, 0 stars>",
        ),
        (lambda: MotionResult(StreakStatus.BLACK, 0, 0.5, reason="dark"), "<MotionResult black: dark>"),
        (
            lambda: HorizonSolution(HorizonStatus.FOUND, nadir=NADIR),
            r"<HorizonSolution found: nadir \[0.60000, "
            r"0.00000, 0.80000\], 1 sigma 0.057 deg>",
        ),
        (
            lambda: HorizonSolution(HorizonStatus.NO_HORIZON, "all dark"),
            "<HorizonSolution no-horizon: all dark>",
        ),
        (lambda: DetectedObjects((), NONE, np.empty((0, 3, 3)), "dark"), "<DetectedObjects: dark>"),
        (lambda: DetectedObjects((), NONE, np.empty((0, 3, 3))), "<DetectedObjects: 0 objects>"),
        (
            lambda: DetectedObjects((OBJECT,), np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3, 3))),
            r"<DetectedObjects: 1 object at pixels \(20.0, 30.0\)>",
        ),
        (lambda: SunSolution(SunStatus.NO_SUN, "all dark"), "<SunSolution no-sun: all dark>"),
        (
            lambda: SunSolution(SunStatus.FOUND, sun=SUN),
            r"<SunSolution found: direction \[0.60000, 0.00000, 0.80000\], 1 sigma 0.057 deg>",
        ),
        (
            default_index,
            r"<SkyIndex: <GuideStars: \d+ stars to V 8.5, epoch 2026.5>, <TriangleIndex: \d+ triangles>>",
        ),
        (
            lambda: plan_step(PLANT, start_angle=0.0, end_angle=0.5, horizon=15.0),
            "<StepPlan optimal: 15 s, heat .+ mJ, peak current .+ mA>",
        ),
    ],
)
def test_a_result_is_shown_in_one_line(result: Callable[[], object], shown: str) -> None:
    """The text of a result is one line.

    The arrays of the result would fill pages in an interactive session.
    """
    assert re.fullmatch(shown, repr(result()))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'StarTrackr'"):
        LIB.StarTrackr  # noqa: B018 - the access is the test


def test_importing_the_library_imports_none_of_its_modules() -> None:
    """The import of the library loads no other modules until a name is used.

    A program that needs one name does not load the modules of all other names.
    """
    script = "import sys, knightcube; print([m for m in sys.modules if m.startswith('knightcube.')])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


RoughAttitude: Any = settings.RoughAttitude
SensedDirection: Any = settings.SensedDirection
NAN = float("nan")
IMAGE: Any = np.random.default_rng(1).poisson(100.0, (64, 64))
CAMERA = Pinhole(64, 64, 100.0)
SLEW: dict[str, Any] = {
    "inertia": [1e-3] * 3,
    "dipole_limit": [0.1] * 3,
    "heat": [50.0] * 3,
    "elements": ("", ""),
    "time": datetime(2026, 3, 20),
    "start": PointingTarget(Goal.NADIR),
    "goal": PointingTarget(Goal.SUN),
    "duration": 600.0,
}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: LIB.StarTracker(settings=5), "settings: 5: give an object of the class SolveSettings"),
        (
            lambda: LIB.StarTracker(camera=CAMERA).solve(IMAGE[1:]),
            "64 x 63 pixels, .*: give images of one camera",
        ),
        (lambda: LIB.estimate_rate(IMAGE, CAMERA, 1.0, settings=0), "settings: 0: .* LikelihoodSettings"),
        (lambda: LIB.estimate_rate(IMAGE, CAMERA, 1e300), "exposure: 1e.300: give 1e-06 to 100000 seconds"),
        (lambda: LIB.detect_objects(IMAGE, CAMERA, [0, 0, 1], 1e-9), "exposure: 1e-09: give"),
        (lambda: LIB.StarTracker(camera=CAMERA).solve(IMAGE, exposure=1e9), "exposure: 1e.09: give"),
        (lambda: LIB.find_nadir(1e200 * (1.0 + IMAGE), CAMERA), "image: pixels from .* scale them down"),
        (
            lambda: LIB.detect_objects(IMAGE, CAMERA, [0, 0, 1], 1.0, {}),
            "settings: {}: .* ObjectSettings",
        ),
        (lambda: LIB.find_sun(IMAGE, CAMERA, "x"), "settings: 'x': .* SunSettings"),
        (
            lambda: LIB.find_nadir(IMAGE, CAMERA, {"altitude": 5e5}),
            "knowledge: {'altitude'.*: give",
        ),
        (lambda: LIB.find_nadir(IMAGE, CAMERA, None, 5), "settings: 5: .* HorizonSettings"),
        (
            lambda: LIB.find_nadir(IMAGE, CAMERA, hidden=IMAGE[1:] > 0),
            r"hidden: an array of shape \(63",
        ),
        (
            lambda: LIB.find_nadir(IMAGE, CAMERA, hidden=0.5 * IMAGE),
            "hidden: pixels of float64: give",
        ),
        (lambda: LIB.HorizonKnowledge(position=[7e6, None, 0]), "position: .*: give finite numbers"),
        (lambda: LIB.HorizonKnowledge(sun=[0, 0, 0]), "sun: .* whose length is not zero"),
        (lambda: LIB.HorizonKnowledge(pole=[0, 0, 0]), "pole: .* whose length is not zero"),
        (lambda: LIB.HorizonKnowledge(attitude=[0, 0, 0, 1]), "attitude: .* RoughAttitude"),
        (lambda: LIB.HorizonKnowledge(sensed=([0, 0, 1],)), "sensed: .* SensedDirection"),
        (lambda: RoughAttitude([0, 0, 0, 2], 0.1), "quaternion: .* give a quaternion of length 1, scalar"),
        (lambda: RoughAttitude([0, 0, 0, 1], 0.0), "sigma: 0.0: give a standard deviation above 0 rad"),
        (lambda: SensedDirection(np.zeros(3), [1, 0, 0], 0.1), "camera: .* whose length is not zero"),
        (lambda: SensedDirection([1, 0, 0], [1, 0, NAN], 0.1), "inertial: .*nan.*: give finite numbers"),
        (lambda: SensedDirection([1, 0, 0], [1, 0, 0], -0.1), "sigma: -0.1: give a standard deviation of 0"),
        (
            lambda: LIB.plan_step(None, start_angle=0, end_angle=1, horizon=9),
            "plant: None: .*AxisPlant",
        ),
        (lambda: LIB.propagate_elements(("", ""), datetime(2026, 3, 20)), "times: .* such as"),
        (lambda: LIB.plan_slew(**SLEW, cones=["sun"]), r"cones: \['sun'\]: .* Mapping"),
        (lambda: LIB.calibrate_lens([]), "images: no image"),
        (
            lambda: LIB.calibrate_lens([IMAGE, "b.png"]),
            "images, number 2: b.png: give an array of pixels",
        ),
        (
            lambda: LIB.calibrate_lens([IMAGE, IMAGE[1:]]),
            r"images, number 2: an array of shape \(63, 64\), but the first image has \(64, 64\)",
        ),
    ],
)
def test_an_argument_of_another_type_is_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        call()


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda value: SunSettings(stride=value), "stride"),
        (lambda value: settings.EdgeSettings(run=value), "run"),
        (lambda value: settings.HorizonSettings(tries=value), "tries"),
        (
            lambda value: LIB.detect_objects(
                IMAGE, CAMERA, [0, 0, 1], 1.0, ObjectSettings(most_points=value)
            ),
            "settings.most_points",
        ),
        (
            lambda value: LIB.estimate_rate(
                IMAGE, CAMERA, 1.0, settings=LikelihoodSettings(most_stars=value)
            ),
            "settings.most_stars",
        ),
        (
            lambda value: StarTracker(
                settings=SolveSettings(identification=IdentificationSettings(work=value))
            ),
            "settings.identification.work",
        ),
        (
            lambda value: StarTracker(settings=SolveSettings(detection=DetectionSettings(window=value))),
            "settings.detection.window",
        ),
    ],
)
def test_a_setting_that_must_be_a_whole_number_is_named(call: Callable[[Any], object], name: str) -> None:
    with pytest.raises(ArgumentError, match=f"^{name}: 7.5: give a whole number"):
        call(7.5)
    call(np.int64(7))


def test_a_roll_that_is_rounded_to_a_revolution_is_shown_as_zero() -> None:
    solved = StarTracker(camera=CAMERA).solve(IMAGE)
    fix = SimpleNamespace(fix=solved)
    shown = repr(replace(solved, frame=cast(Any, fix), roll=-1e-9 % (2.0 * np.pi), covariance=np.eye(3)))
    assert " roll 0.000 deg, " in shown


def test_a_rate_is_true_if_it_was_found() -> None:
    found = MotionResult(StreakStatus.RATE, 0, 1.0, rate=np.zeros(3), covariance=np.eye(3))
    assert found
    assert not replace(found, rate=None)


def test_vectors_can_be_lists_for_type_checkers_too() -> None:
    """The functions accept lists and tuples at run time, and in the type checker, which reads this file."""
    solution = StarTracker(camera=CAMERA).solve(IMAGE, attitude=(0, 0, 0, 1), rate=[0, 0, 1], exposure=1.0)
    assert not solution
    assert not estimate_rate(IMAGE, CAMERA, 1.0, prior_rate=(0, 0, 1))
    assert not detect_objects(IMAGE, CAMERA, [0, 0, 0.1], 1.0)


def test_numbers_of_a_target_and_times_of_a_path_can_be_lists() -> None:
    """A target with a list equals the target with a tuple, and does not change with the list."""
    numbers = [0.0, 0.0, 0.0, 1.0]
    target = LIB.PointingTarget(Goal.INERTIAL, numbers)
    numbers[0] = 9.0
    assert target == PointingTarget(Goal.INERTIAL, (0.0, 0.0, 0.0, 1.0))
    path = LIB.plan_step(PLANT, start_angle=0.0, end_angle=0.5, horizon=15.0).path
    np.testing.assert_array_equal(path.motion([0.0, 20.0]), path.motion(np.array([0.0, 20.0])))
    assert path.motion([0.0, 20.0])[0] == pytest.approx([0.0, 0.5])


def test_prior_directions_can_be_lists() -> None:
    sensed = SensedDirection([1, 0, 0], (0, 1, 0), 0.1)
    known = LIB.HorizonKnowledge(altitude=5e5, attitude=RoughAttitude([0, 0, 0, 1], 0.1), sensed=(sensed,))
    assert not find_nadir(IMAGE, CAMERA, known)
    located = LIB.HorizonKnowledge(position=[7e6, 0, 0], sun=(0, 1, 0), pole=[0, 0, 1])
    assert all(isinstance(vector, np.ndarray) for vector in (located.position, located.sun, located.pole))


LINES = (
    "1 99999U 26001A   26079.50000000  .00000000  00000-0  00000+0 0    05",
    "2 99999  97.4640 337.4170 0011973 295.7805  64.3547 15.24067411    09",
)
NOON, PLACE = datetime(2026, 3, 20, 12), [7e6, 0.0, 0.0]
LENS: dict[str, Any] = {"columns": 64, "rows": 64, "focal_length": 300.0, "centre": (32.0, 31.0)}
CALLS: dict[str, dict[str, Any]] = {
    "SingleAxisPlant": {
        "inertia": 1.0, "torque_constant": 1.0, "resistance": 1.0, "current_limit": 1.0, "stiffness": 1.0,
        "damping": 1.0, "disturbance": 1.0,
    },
    "plan_step": {
        "plant": PLANT, "start_angle": 0.0, "end_angle": 0.3, "horizon": 12.0, "start_rate": 0.0,
        "end_rate": 0.0, "time_cost": 0.01, "minimise": "heat", "nodes": 12, "max_stretch": 2.0,
    },
    "plan_slew": {
        "inertia": [1e-3] * 3, "dipole_limit": [0.1] * 3, "heat": [50.0] * 3, "elements": LINES, "time": NOON,
        "start": PointingTarget(Goal.NADIR), "goal": PointingTarget(Goal.SUN), "duration": 600.0,
        "longest": 700.0, "window": 0.0, "time_cost": 0.01, "pointing_axis": [0, 0, 1],
        "across_axis": [1, 0, 0], "camera_axis": [0, 0, 1], "cones": {"moon": 0.2}, "nodes": 12,
    },
    "plan_pointing": {
        "inertia": [1e-3] * 3, "dipole_limit": [0.1] * 3, "elements": LINES, "time": NOON,
        "target": PointingTarget(Goal.SUN), "quaternion": [0, 0, 0, 1], "rate": [0, 0, 0],
        "weights": LIB.PointingWeights(turn=0.02, rate=1.0, dipole=3e-4), "pointing_axis": [0, 0, 1],
        "across_axis": [1, 0, 0],
    },
    "attitude_error": {"true": [0, 0, 0, 1], "estimated": [0, 0, 0, 1]},
    "check_consistency": {
        "errors": [[1.0]], "covariances": [[[1.0]]], "confidence": 0.9, "independent": 1,
    },
    "PointingTarget": {"goal": Goal.GROUND, "numbers": (0.1, 0.2), "roll": 0.1},
    "Goal.named": {"label": "sun"},
    "Pinhole": {"columns": 64, "rows": 64, "focal_length": 300.0},
    "Pinhole.from_field_of_view": {"columns": 64, "rows": 64, "field_of_view": 0.3},
    "Lens": LENS | dict.fromkeys(("k1", "k2", "aspect", "shear", "p1", "p2"), 0.0),
    "Lens.of": {"camera": CAMERA},
    "StarTracker": {"fov_deg": 12.0, "fov_error_deg": 0.5, "settings": None, "learn": False},
    "calibrate_lens": {"images": [IMAGE], "fov_deg": 12.0, "progress": None},
    "detect_objects": {
        "image": IMAGE, "camera": CAMERA, "rate": [0, 0.1, 0], "exposure": 0.2, "settings": None,
    },
    "estimate_rate": {
        "image": IMAGE, "camera": CAMERA, "exposure": 0.2, "prior_rate": [0, 0.1, 0], "prior_sigma": 0.1,
        "settings": None,
    },
    "find_nadir": {
        "image": IMAGE, "camera": CAMERA, "knowledge": None, "settings": None, "hidden": IMAGE > 0.0
    },
    "HorizonKnowledge": {
        "position": PLACE, "altitude": 5e5, "sun": [1, 0, 0], "pole": [0, 0, 1], "attitude": None,
        "sensed": (),
    },
    "find_sun": {"image": IMAGE, "camera": CAMERA, "settings": None},
    "magnetic_field": {"time": NOON, "position": PLACE},
    "magnetic_field_on_ground": {"time": NOON, "latitude": 0.1, "longitude": 0.2, "height": 0.0},
    "orbit_state": {
        "semi_major_axis": 7e6, "eccentricity": 0.0, "inclination": 1.0, "ascending_node": 0.0,
        "argument_of_perigee": 0.0, "true_anomaly": 0.0,
    },
    "propagate_orbit": {"position": PLACE, "velocity": [0.0, 7500.0, 0.0], "seconds": [0.0]},
    "propagate_elements": {"elements": LINES, "times": [NOON]},
    "sun_direction": {"time": NOON, "position": PLACE, "velocity": [0.0, 7500.0, 0.0]},
    "sunlit_fraction": {"time": NOON, "position": PLACE, "shadow": "conical"},
    "read_image": {"path": "none.png"},
}  # fmt: skip
METHODS: dict[str, dict[str, Any]] = {
    "rescaled": {"factor": 1.1},
    "binned": {"columns": 32, "rows": 32, "size": 2},
    "project": {"vectors": [[0.0, 0.0, 1.0]]},
    "unit_vectors": {"points": [[3.0, 4.0]]},
    "contains": {"points": [[3.0, 4.0]], "margin": 1.0},
}
WRONG: tuple[Any, ...] = ("x", object(), [[1.0, 2.0], [3.0]], 1j, 10**400, np.array(["a", "b", "c"]))


def test_every_function_is_tested_with_wrong_types() -> None:
    functions = {name for name in LIB.__all__ if not inspect.isclass(getattr(LIB, name))}
    assert functions <= CALLS.keys()
    for name, given in CALLS.items():
        named = {*inspect.signature(reduce(getattr, name.split("."), LIB)).parameters}
        assert named - given.keys() <= {"camera", "index", "upright"}


@pytest.mark.parametrize(
    "name", [*CALLS, *(f"{kind} {name}" for name in METHODS for kind in ("Pinhole", "Lens"))]
)
def test_an_argument_of_a_wrong_type_is_refused_by_an_error_of_the_library(name: str) -> None:
    """The message is short and has one line."""
    kind, _, method = name.partition(" ")
    camera = CAMERA if kind == "Pinhole" else Lens(**LENS)
    call = getattr(camera, method) if method else reduce(getattr, name.split("."), LIB)
    given = METHODS[method] if method else CALLS[name]
    for argument in given:
        for wrong in WRONG:
            with pytest.raises(KnightCubeError) as refused:
                call(**given | {argument: wrong})
            assert 0 < len(str(refused.value)) < 500
            assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("function", "settings"),
    [(estimate_rate, LikelihoodSettings), (detect_objects, ObjectSettings)],
)
@pytest.mark.parametrize("wrong", [0.0, -1.0, float("nan"), "x"])
@pytest.mark.parametrize("name", ["gain", "psf_sigma", "saturation"])
def test_an_impossible_detector_is_refused(
    function: Callable[..., Any], settings: Callable[..., Any], wrong: Any, name: str
) -> None:
    given = {"rate": [0, 0.1, 0]} if function is detect_objects else {}
    with pytest.raises(ArgumentError, match=f"settings.{name}: "):
        function(IMAGE, CAMERA, exposure=1.0, settings=settings(**{name: wrong}), **given)


@pytest.mark.parametrize(
    ("knowledge", "text"),
    [
        (None, "settings.knowledge: None: give a CameraKnowledge"),
        (
            CameraKnowledge(focal_length=-1.0),
            "settings.knowledge.focal_length: -1.0: give a standard deviation",
        ),
        (CameraKnowledge(centre=math.nan), "settings.knowledge.centre: nan: give a standard deviation"),
        (CameraKnowledge(covariance=((1.0,),)), "settings.knowledge.covariance: .* shape"),
    ],
    ids=["none", "negative", "nan", "shape"],
)
def test_a_rate_needs_valid_deviations_of_the_camera(knowledge: Any, text: str) -> None:
    with pytest.raises(ArgumentError, match=text):
        estimate_rate(IMAGE, CAMERA, 0.5, settings=LikelihoodSettings(knowledge=knowledge))


def test_settings_of_rates_and_objects_have_their_kinds() -> None:
    wrong = LikelihoodSettings(rate_model="linear")  # type: ignore[arg-type]  # wrong on purpose
    with pytest.raises(ArgumentError, match="rate_model: 'linear': give one of auto, constant, accelerating"):
        estimate_rate(IMAGE, CAMERA, 0.5, settings=wrong)
    with pytest.raises(ArgumentError, match=r"bounds: .* shape \(3,\)"):
        ObjectSettings(bounds=(8.0, 10.0))  # type: ignore[arg-type]  # wrong on purpose


@pytest.mark.parametrize("reach", [1e6, 0.5, -3.6, math.nan])
def test_a_reach_that_exhausts_the_memory_is_refused(reach: float) -> None:
    with pytest.raises(ArgumentError, match=r"settings.reach: .*: give 1 to 20 point-spread widths"):
        estimate_rate(IMAGE, CAMERA, 1.0, settings=LikelihoodSettings(reach=reach))


@pytest.mark.parametrize("line_time", [0.02, -0.02, float("inf")])
def test_a_line_time_in_another_unit_is_refused(line_time: float) -> None:
    with pytest.raises(ArgumentError, match=r"settings.line_time: .* s per row"):
        estimate_rate(IMAGE, CAMERA, 1.0, settings=LikelihoodSettings(line_time=line_time))


@pytest.mark.parametrize("kind", [bool, np.uint8, np.int64])
def test_a_mask_of_integers_hides_the_pixels_that_are_not_zero(kind: type[np.generic]) -> None:
    """A mask without hidden pixels changes nothing, and a mask of hidden pixels removes all edges."""
    image = np.where(np.arange(64)[:, None] + np.arange(64) > 60, 200.0, 5.0)
    edges = len(find_nadir(image, CAMERA).points)
    assert len(find_nadir(image, CAMERA, hidden=np.zeros((64, 64), kind)).points) == edges > 20
    assert len(find_nadir(image, CAMERA, hidden=np.full((64, 64), 2, kind)).points) == 0
