"""Tests of `knightcube rate`, which gives the rate in an image, its covariance, and a plot of the streaks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pillow = pytest.importorskip("PIL.Image", reason="needs the extra `images`")

from ground.commands import rate  # noqa: E402
from knightcube.vision.camera.images import write_picture  # noqa: E402
from knightcube.vision.streaks.streak_result import (  # noqa: E402
    LikelihoodSettings,
    MotionResult,
    StreakStatus,
)
from sim_hal.star_camera import StarCameraModel  # noqa: E402
from tests.ground.commands.in_process import command  # noqa: E402
from tests.knightcube.vision.objects.space_objects import (  # noqa: E402
    frame_with,
    motion_across,
    object_path,
)
from tests.support.fits_files import fits_file  # noqa: E402
from tests.support.scenes import Scene, slew  # noqa: E402
from tests.support.streak_frames import rate_at, star_camera  # noqa: E402

CAMERA = StarCameraModel(columns=640, rows=640, field_of_view=float(np.deg2rad(12.5)))
FOV = "12.5"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return slew(np.random.default_rng(20), float(np.deg2rad(80.0)), 0.12, 0.2, model=CAMERA)


@pytest.fixture(scope="module")
def picture(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pictures") / "frame.png"
    pillow.fromarray(scene.pixels).save(path, compress_level=1)
    return path


@pytest.mark.parametrize("method", ["likelihood", "harris"])
def test_an_approximate_prior_gives_the_rate_with_its_sign(scene: Scene, picture: Path, method: str) -> None:
    prior = [f"{1.3 * component:.4f}" for component in scene.rate]
    done = command(
        "rate", picture, "--fov", FOV, "--exposure", "0.2", "--method", method, "--json", "--prior", *prior
    )
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["status"] == "rate"
    error = np.array(facts["rate_rad_s"]) - scene.rate
    covariance = np.array(facts["covariance_rad2_s2"])
    assert np.linalg.norm(error) < 0.02 * np.linalg.norm(scene.rate)
    assert error @ np.linalg.solve(covariance, error) < 25.0
    assert len(facts["streaks"]) >= 4


def test_without_a_prior_the_direction_of_time_is_reported_as_unknown(scene: Scene, picture: Path) -> None:
    done = command("rate", picture, "--fov", FOV, "--exposure", "0.2")
    assert done.returncode == 0, done.stderr
    assert "ambiguous" in done.stdout
    assert "give --prior" in done.stdout


def test_a_picture_of_floating_point_numbers_gives_the_same_rate(
    scene: Scene, picture: Path, tmp_path: Path
) -> None:
    (tmp_path / "frame.fits").write_bytes(fits_file(scene.pixels.astype(">f4"), -32))
    options = ("--fov", FOV, "--exposure", "0.2", "--json")
    rates = [
        json.loads(command("rate", path, *options).stdout)["rate_rad_s"]
        for path in (tmp_path / "frame.fits", picture)
    ]
    assert rates[0] is not None
    assert rates[0] == rates[1]


def test_the_overlay_marks_the_streaks_in_colour(picture: Path, tmp_path: Path) -> None:
    overlay = tmp_path / "found.png"
    done = command("rate", picture, "--fov", FOV, "--exposure", "0.2", "--overlay", overlay)
    assert done.returncode == 0, done.stderr
    drawn = np.asarray(pillow.open(overlay))
    assert drawn.shape == (640, 640, 3)
    assert (drawn.max(axis=2) != drawn.min(axis=2)).sum() > 100


def test_a_picture_without_stars_gives_no_rate_and_exit_status_1(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).normal(120.0, 10.0, (256, 256)).astype(np.uint16)
    path = tmp_path / "noise.png"
    pillow.fromarray(noise).save(path, compress_level=1)
    done = command("rate", path, "--fov", "5", "--exposure", "1", "--json")
    assert done.returncode == 1
    assert "expose longer" in command("rate", path, "--fov", "5", "--exposure", "1").stdout
    facts = json.loads(done.stdout)
    assert facts["rate_rad_s"] is None
    assert facts["status"] in {"too-few", "failed", "too-short"}


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["nothing.png", "--fov", "20", "--exposure", "1"], "nothing.png: cannot be read"),
        (["{picture}", "--fov", "20"], "states no exposure time: give --exposure S or --camera CONFIG"),
        (["{picture}", "--camera", "config/testbed.yaml"], "give a configuration with a camera"),
        (["{picture}", "--fov", "170", "--exposure", "1"], "--fov 170: must be 0.1 to 120 deg"),
        (
            ["{picture}", "--fov", "20", "--exposure", "1", "--line-time", "-1"],
            "--line-time -1: must be 0 to",
        ),
        (["{picture}", "--fov", "20", "--exposure", "1", "--line-time", "0.1"], "a readout of 1 s"),
        (["{picture}", "--fov", "20", "--overlay", "{picture}"], "would replace a file that is read"),
        (
            ["{picture}", "--fov", "20", "--overlay", "config/testbed.yaml"],
            "exists already and is not a PNG file",
        ),
        (["{picture}", "--camera", "step_demo", "--fov-error", "1"], "--fov-error 1: only with --fov"),
    ],
)
def test_a_mistake_is_one_line(words: list[str], complaint: str, picture: Path) -> None:
    done = command("rate", *[word.format(picture=picture) for word in words])
    assert done.returncode == 2
    assert complaint in done.stderr
    assert done.stderr.count("\n") == 1


def test_options_describe_the_camera_and_a_refusal_states_the_reason(scene: Scene, picture: Path) -> None:
    """A stated point spread function that is too wide increases the uncertainty, or leads to a refusal.

    The true width is 1 px. With a stated width of 2 px, the uncertainty is larger. With a stated width of 4
    px, the command refuses to give a rate.
    """
    told = [
        "--fov",
        FOV,
        "--exposure",
        "0.2",
        "--gain",
        "1",
        "--saturation",
        "4095",
        "--line-time",
        "0",
        "--json",
    ]
    right = json.loads(command("rate", picture, *told, "--psf", "1").stdout)
    assert right["status"] == "ambiguous"
    assert right["reason"] == ""
    doubted = json.loads(command("rate", picture, *told, "--psf", "2").stdout)
    claims = [np.trace(found["covariance_rad2_s2"]) for found in (right, doubted)]
    assert claims[1] > 2.0 * claims[0]
    wrong = command("rate", picture, *told, "--psf", "4")
    assert wrong.returncode == 1
    assert "times as wide as configured" in json.loads(wrong.stdout)["reason"]


def test_the_configuration_of_a_camera_states_its_uncertainty(picture: Path, tmp_path: Path) -> None:
    def sigma(accuracy: str) -> float:
        path = tmp_path / "camera.yaml"
        lens = f"{{focal_length: {CAMERA.pinhole.focal_length}, centre: [319.5, 319.5]}}"
        size = "columns: 640, rows: 640, bits: 12, exposure: 0.2, line_time: 0.0"
        path.write_text(f"camera: {{{size}, lens: {lens}, accuracy: {accuracy}}}\n")
        done = command("rate", picture, "--camera", path, "--json")
        assert done.returncode == 0, done.stderr
        return float(np.sqrt(np.trace(json.loads(done.stdout)["covariance_rad2_s2"])))

    exact, usual = sigma("{centre: 0.0, distortion: 0.0}"), sigma("{}")
    assert exact < 0.9 * usual


@pytest.mark.parametrize("factor", [20.0, 0.05])
@pytest.mark.parametrize("command_name", ["rate", "solve"])
def test_a_prior_of_another_size_does_not_determine_the_sign(
    scene: Scene, picture: Path, command_name: str, factor: float
) -> None:
    words = (command_name, picture, "--fov", FOV, "--exposure", "0.2")
    prior = ("--prior", *(f"{factor * component:.6f}" for component in scene.rate))
    done = command(*words, *prior)
    assert done.returncode == 0, done.stderr
    assert "not used: " in done.stdout
    assert "check its axes and its unit (rad/s)" in done.stdout
    assert "unknown, the rate may have the opposite sign" in done.stdout


def test_a_prior_across_the_axis_does_not_determine_the_sign(scene: Scene, picture: Path) -> None:
    aside = np.cross(scene.rate, [0.0, 0.0, 1.0])
    aside *= np.linalg.norm(scene.rate) / np.linalg.norm(aside)
    words = ("--fov", FOV, "--exposure", "0.2", "--json", "--prior")
    facts = json.loads(command("rate", picture, *words, *map(str, aside + 0.1 * scene.rate)).stdout)
    assert (facts["status"], facts["prior_used"]) == ("ambiguous", False)


def test_the_error_of_the_field_of_view_is_in_the_uncertainty(scene: Scene, picture: Path) -> None:
    """The field of view is 5 % too large, so the rate across the boresight is too."""
    prior = ("--prior", *map(str, scene.rate))

    def sigmas(*more: str) -> float:
        words = ("--fov", "13.1", *more, "--exposure", "0.2", "--json", *prior)
        facts = json.loads(command("rate", picture, *words).stdout)
        error = np.array(facts["rate_rad_s"]) - scene.rate
        return float(error @ np.linalg.solve(facts["covariance_rad2_s2"], error))

    assert sigmas("--fov-error", "0.6") < 12.0
    assert sigmas() > 100.0
    assert (
        "field of view: assumed to be exact"
        in command("rate", picture, "--fov", FOV, "--exposure", "0.2").stdout
    )


def test_the_exposure_is_that_of_the_picture_unless_another_is_given(
    scene: Scene, picture: Path, tmp_path: Path
) -> None:
    path, config = tmp_path / "frame.png", tmp_path / "camera.yaml"
    write_picture(path, scene.pixels, 0.2)
    config.write_text("camera: {columns: 640, rows: 640, bits: 12, field_of_view_deg: 12.5, exposure: 1.0}\n")
    done = command("rate", path, "--camera", config, "--json")
    assert json.loads(done.stdout)["exposure_s"] == pytest.approx(0.2)
    assert "0.2 s; the configuration states 1 s" in done.stderr
    given = command("rate", path, "--camera", config, "--json", "--exposure", "0.4")
    assert json.loads(given.stdout)["exposure_s"] == 0.4
    assert "0.4 s; the picture states 0.2 s" in given.stderr
    assert json.loads(command("rate", picture, "--camera", config, "--json").stdout)["exposure_s"] == 1.0


def test_slow_rates_have_an_uncertainty_of_two_digits(picture: Path) -> None:
    shown = command("rate", picture, "--fov", FOV, "--exposure", "2000").stdout
    line = next(line for line in shown.splitlines() if line.startswith("rate x, y, z:"))
    assert all(float(word) > 0.0 for word in line.split("+- ")[1].split()[:1])
    assert "+- 0.0000 " not in line


def test_an_unspecified_shutter_increases_the_uncertainty_and_the_command_asks_for_it(picture: Path) -> None:
    usual = "--fov", FOV, "--exposure", "0.2"

    def sigma(*more: str) -> float:
        facts = json.loads(command("rate", picture, *usual, *more, "--json").stdout)
        assert facts["shutter_described"] is bool(more)
        return float(np.sqrt(np.trace(facts["covariance_rad2_s2"])))

    assert sigma("--line-time", "0") < sigma()
    assert "--line-time" in command("rate", picture, *usual).stdout
    assert "--line-time" not in command("rate", picture, *usual, "--line-time", "0").stdout


def test_an_object_is_searched_with_the_stated_point_spread() -> None:
    camera = star_camera(512, 1.6)
    pinhole = camera.pinhole
    turn = rate_at(np.deg2rad(60.0), 55.0 / pinhole.focal_length, 0.4)
    place = pinhole.unit_vectors(np.array([[270.0, 230.0]]))[0]
    path = object_path(camera, place, motion_across(place, 25.0 / pinhole.focal_length, 0.3), turn)
    pixels = frame_with(camera, turn, 1.0, 6, [(path, 2.5)], 6.0)
    found = MotionResult(StreakStatus.RATE, 0, 1.0, rate=turn)
    settings = LikelihoodSettings(saturation=camera.full_well, psf_sigma=1.6)
    seen, reason = rate._objects(pixels, pinhole, found, settings, 1.0)
    assert (len(seen), reason) == (1, "")
    assert np.linalg.norm(seen[0].endpoints.mean(axis=0) - path.mean(axis=0)) < 0.5


def test_the_reason_why_no_objects_were_searched_is_stated(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    picture = tmp_path / "noise.png"
    write_picture(picture, np.clip(random.normal(100.0, 3.0, (256, 256)), 0, 4095).astype(np.uint16), 0.2)
    done = command("rate", picture, "--fov", FOV, "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)["objects_reason"] == "the rate is not known"


def test_a_rate_that_contradicts_the_streaks_is_stated(
    scene: Scene, picture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimated: Any = vars(rate)["estimate_motion"]

    def wrong(*arguments: Any) -> Any:
        found = estimated(*arguments)
        return replace(found, rate=1.5 * found.rate)

    monkeypatch.setattr(rate, "estimate_motion", wrong)
    words = ("rate", picture, "--fov", FOV, "--exposure", "0.2")
    found = json.loads(command(*words, "--json").stdout)
    assert "rate" in found["objects_reason"]
    assert f"objects:       not searched: {found['objects_reason']}" in command(*words).stdout
