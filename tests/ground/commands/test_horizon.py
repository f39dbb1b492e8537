"""Tests of `knightcube horizon`, which gives the nadir direction of an image as numbers and as a drawing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pillow = pytest.importorskip("PIL.Image", reason="needs the extra `images`")

from knightcube.astro.quaternion import from_rotation_vector, multiply  # noqa: E402
from sim_hal.earth_camera import EarthCameraModel, nadir, render  # noqa: E402
from tests.ground.commands.in_process import command  # noqa: E402
from tests.sim_hal.earth_camera.scenes import limb_scene  # noqa: E402
from tests.support.limb_frames import camera_model  # noqa: E402

MODEL = camera_model()
SCENE = limb_scene(zenith=np.array([1.0, 0.0, 0.1]), sun=np.array([1.0, 0.6, 0.5]), texture=3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with grey and colour images of the limb, an image of the sky, and the camera file."""
    folder = tmp_path_factory.mktemp("limb")
    frame = render(MODEL, SCENE, np.random.default_rng(4))
    pillow.fromarray(frame).save(folder / "limb.png")
    pillow.fromarray(np.stack([frame] * 3, axis=2)).save(folder / "colour.png")
    pillow.fromarray(np.full((512, 512), 9, np.uint8)).save(folder / "sky.png")
    return folder


def _response() -> tuple[str, ...]:
    return "--log-response", str(MODEL.pedestal), str(MODEL.counts_per_decade)


def test_json_shows_nadir_with_its_covariance(folder: Path) -> None:
    done = command("horizon", folder / "limb.png", "--fov", "67", "--altitude", "600", *_response(), "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["status"] == "found"
    off = np.degrees(np.arccos(np.array(facts["nadir_camera"]) @ nadir(SCENE)))
    # The lens has a distortion of up to 20 px at the corners. The command and its covariance do not account
    # for this distortion.
    assert off < 1.0
    assert np.all(np.linalg.eigvalsh(np.array(facts["covariance_rad2"])) > -1e-15)
    assert facts["sigma_deg"] > 0.05
    assert len(facts["limb_points_px"]) == facts["edges_used"]
    assert "altitude_km" not in facts


def test_colour_without_an_altitude_gives_one_and_a_picture(folder: Path) -> None:
    overlay = folder / "found.png"
    done = command("horizon", folder / "colour.png", "--fov", "67", *_response(), "--overlay", overlay)
    assert done.returncode == 0, done.stderr
    for label in ("nadir x, y, z:", "1 sigma:", "residual", "altitude:", str(overlay)):
        assert label in done.stdout
    drawn = np.asarray(pillow.open(overlay)).astype(int)
    orange = np.count_nonzero(np.all(np.abs(drawn - [230, 159, 0]) < 2, axis=2))
    # The image shows the limb as a line across the whole width, and each edge as a ring.
    assert orange > 512


def test_a_picture_without_a_horizon_is_reported_with_exit_status_1(folder: Path) -> None:
    done = command("horizon", folder / "sky.png", "--fov", "67", "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)["status"] == "no-horizon"


LEVEL = limb_scene(
    zenith=np.array([1.0, 0.0, 0.1]),
    sun=np.array([1.0, 0.6, 0.5]),
    dip=float(np.arcsin(6_378.137 / 6_978.137) - 0.5 * np.pi),
)
"""In this scene the boresight is horizontal, and the limb is 24 deg below the boresight."""


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    """Return a folder with three images, and their nadir directions by name.

    The images `first` and `later` are from a horizontal camera at two times, and the image `right` is from a
    camera that points farther to the right.
    """
    folder = tmp_path_factory.mktemp("paper")
    model = EarthCameraModel.fuga15d(seed=1)
    turns = {"first": (0.0, 0.0, 0.0), "right": (0.0, 1.0, 0.0), "later": (0.02, 0.0, 0.0)}
    downs = {}
    for name, turn in turns.items():
        attitude = multiply(from_rotation_vector(np.array(turn)), LEVEL.attitude)
        scene = replace(LEVEL, attitude=attitude)
        pillow.fromarray(render(model, scene, np.random.default_rng(2))).save(folder / f"{name}.png")
        downs[name] = nadir(scene)
    return folder, downs


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        ("first", ("--method", "circle", "--altitude", "600")),
        ("first", ("--method", "circle", "--altitude", "600", "--lines", "32")),
        ("first", ("--method", "graphic", "--altitude", "600", "--second", "right", "--turned", "57.29578")),
        ("later", ("--method", "vector", "--altitude", "600", "--second", "first")),
        ("later", ("--method", "vector", "--second", "first", "--nadir")),
    ],
)
def test_the_papers_methods_find_nadir_of_a_level_sunlit_limb_to_a_degree(
    picture: str, words: tuple[str, ...], pictures: tuple[Path, dict[str, np.ndarray]]
) -> None:
    folder, downs = pictures
    said = [f"{folder / word}.png" if word in downs else word for word in words]
    if words[-1] == "--nadir":
        said += [f"{part:.6f}" for part in downs["first"]]
    done = command("horizon", folder / f"{picture}.png", "--fov", "67", *said, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["method"] == words[1]
    off = np.degrees(np.arccos(min(1.0, np.array(facts["nadir_camera"]) @ downs[picture])))
    assert off < 1.0
    # An undetected rotation of the camera by 1.1 deg would exceed this limit.
    assert picture == "first" or off < 0.6


def test_the_papers_circle_is_drawn_and_a_dark_picture_has_none(
    folder: Path, pictures: tuple[Path, dict[str, np.ndarray]]
) -> None:
    drawn = pictures[0] / "drawn.png"
    words = ("--fov", "67", "--altitude", "600", "--method", "circle")
    done = command("horizon", pictures[0] / "first.png", *words, "--overlay", drawn)
    assert done.returncode == 0, done.stderr
    assert "1 sigma:          not available with the method circle" in done.stdout
    image = np.asarray(pillow.open(drawn)).astype(int)
    assert np.count_nonzero(np.all(np.abs(image - [230, 159, 0]) < 2, axis=2)) > 400
    dark = command("horizon", folder / "sky.png", *words, "--json")
    assert dark.returncode == 1
    assert json.loads(dark.stdout)["status"] == "no-horizon"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--fov", "170"], "--fov 170: must be 1 to 150 deg"),
        (["--fov", "67", "--altitude", "-3"], "not a positive number"),
        (["--fov", "67", "--altitude", "5"], "--altitude 5: this method needs at least 50 km"),
        (["--fov", "67", "--altitudes", "900", "300"], "altitudes of 900 to 300 km"),
        (["--fov", "67", "--altitude", "600", "--altitudes", "300", "900"], "not allowed with"),
        ([], "--fov --camera"),
        (["--camera", "config/step_demo.yaml"], "512 x 512 pixels, but the camera of"),
        (["--fov", "67", "--camera", "config/step_demo.yaml"], "not allowed with"),
        (["--fov", "67", "--method", "circle"], "--method circle: it needs --altitude"),
        (["--fov", "67", "--method", "vector", "--altitude", "600"], "give the other picture with --second"),
        (
            ["--fov", "67", "--method", "graphic", "--altitude", "600", "--second", "limb.png"],
            "turned to the right",
        ),
        (["--fov", "67", "--turned", "60"], "--turned: only with --method graphic"),
        (["--fov", "67", "--lines", "9"], "--lines: only with --method circle, graphic, vector"),
        (["--fov", "67", "--method", "circle", "--altitude", "600", "--lines", "2"], "--lines 2: give 3 to"),
        (
            ["--fov", "67", "--method", "circle", "--altitude", "600", "--log-response", "8", "41"],
            "uses the counts directly",
        ),
    ],
)
def test_a_mistake_is_reported_with_exit_status_2(words: list[str], complaint: str, folder: Path) -> None:
    done = command("horizon", folder / "limb.png", *words)
    assert done.returncode == 2
    assert complaint in done.stderr
    assert "Traceback" not in done.stderr


def test_a_mask_that_hides_the_whole_picture_is_refused(folder: Path, tmp_path: Path) -> None:
    mask = tmp_path / "mask.png"
    pillow.fromarray(np.ones((512, 512), np.uint8)).save(mask)
    done = command("horizon", folder / "limb.png", "--fov", "67", "--mask", mask)
    assert done.returncode == 2
    assert "every pixel is above 0" in done.stderr


def test_an_uncertain_field_of_view_is_in_the_uncertainty(tmp_path: Path) -> None:
    """In frames of several seeds, a field of view that is 5 % wrong does no harm if its error is given.

    The nadir error then stays within three standard deviations, and is less than half the error without
    `--fov-error`.
    """
    errors = []
    for seed in (1, 2, 3):
        limb = pillow.fromarray(render(MODEL, SCENE, np.random.default_rng(seed)))
        limb.save(tmp_path / "limb.png", compress_level=1)
        found = []
        for field in (("67",), ("70.3",), ("70.3", "--fov-error", "3.3")):
            words = ("--fov", *field, *_response(), "--altitude", "600", "--json")
            done = command("horizon", tmp_path / "limb.png", *words)
            assert done.returncode == 0, done.stderr
            found.append(json.loads(done.stdout))
        off = [np.subtract(each["nadir_camera"], nadir(SCENE)) for each in found]
        spread, axes = np.linalg.eigh(np.array(found[2]["covariance_rad2"]))
        assert np.all(np.abs(off[2] @ axes[:, 1:]) < 3.0 * np.sqrt(spread[1:]))
        errors.append(np.linalg.norm(off[1:], axis=1))
    wrong, described = np.sqrt(np.mean(np.square(errors), axis=0))
    assert described < 0.5 * wrong


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--fov", "67", "--fov-error", "70"], "--fov-error 70: --fov 67 must stay within"),
        (
            ["--fov", "67", "--fov-error", "1", "--method", "circle", "--altitude", "600"],
            "only with --fov",
        ),
    ],
)
def test_a_field_error_that_does_not_apply_is_refused(folder: Path, words: list[str], complaint: str) -> None:
    done = command("horizon", folder / "limb.png", *words)
    assert done.returncode == 2
    assert complaint in done.stderr
