"""Tests of `knightcube calibrate`, which makes a camera file for `knightcube solve` from star images."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pillow = pytest.importorskip("PIL.Image", reason="needs the extra `images`")

from flight.schema.reader import load_camera  # noqa: E402
from tests.ground.commands.in_process import command  # noqa: E402
from tests.knightcube.vision.startracker.frames import NARROW, sky_frame  # noqa: E402


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("night")
    paths = [folder / f"{number}.png" for number in range(3)]
    for number, path in enumerate(paths):
        pillow.fromarray(sky_frame(np.random.default_rng([41, number]), 0.0, 0.5).pixels).save(path)
    return paths


def test_the_lens_found_is_the_one_that_took_the_pictures(pictures: list[Path], tmp_path: Path) -> None:
    """The calibration finds the lens of the simulated camera, which has no distortion and a centred axis.

    All fitted values must lie within five standard deviations of the truth.
    """
    out = tmp_path / "camera.yaml"
    done = command("calibrate", *pictures, "--fov", "12.3", "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    truth = {"focal_length": NARROW.pinhole.focal_length, "k1": 0.0, "k2": 0.0}
    for name, value in truth.items():
        assert abs(facts[name] - value) < 5.0 * facts["sigma"][name], name
    assert facts["rms_px_after"] < 0.3
    solved = command("solve", pictures[0], "--camera", out, "--json")
    assert json.loads(solved.stdout)["field_of_view_deg"] == pytest.approx(12.0, abs=0.005)


def test_what_the_stars_leave_open_is_named_and_not_written(pictures: list[Path], tmp_path: Path) -> None:
    """Parameters that the stars do not determine are named and not written.

    The image covers only the central 7 deg, where a distortion is not measurable.
    """
    middle, out = tmp_path / "middle.png", tmp_path / "camera.yaml"
    pillow.open(pictures[0]).crop((212, 212, 812, 812)).save(middle)
    done = command("calibrate", middle, "--fov", "7.05", "--out", out)
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("k2:")]
    assert "left out, not determined by the stars" in line
    text = out.read_text()
    assert "k2:" not in text
    assert "# The stars do not determine k2" in text
    assert load_camera(out).lens.k2 == 0.0  # type: ignore[union-attr]  # it has just been written


def test_a_camera_file_says_how_well_the_lens_is_known(pictures: list[Path], tmp_path: Path) -> None:
    """`knightcube rate` uses the uncertainty of the focal length in the camera file."""
    out = tmp_path / "camera.yaml"
    done = command("calibrate", *pictures, "--fov", "12", "--out", out, "--json")
    facts = json.loads(done.stdout)
    accuracy = load_camera(out).accuracy
    assert accuracy.focal_length == pytest.approx(facts["accuracy"]["focal_length"], rel=1e-2)
    least = facts["sigma"]["focal_length"] / facts["focal_length"]
    assert 0.99 * least <= accuracy.focal_length < 1e-3
    assert abs(facts["focal_length"] / NARROW.pinhole.focal_length - 1.0) < 5.0 * accuracy.focal_length
    assert 0.0 < accuracy.distortion < 2e-3
    assert accuracy.line_time is None, "no picture of stars that stand still shows that"


def test_a_picture_of_another_focus_is_left_out_and_named(pictures: list[Path], tmp_path: Path) -> None:
    other = tmp_path / "other.png"
    picture = pillow.open(pictures[0])
    picture.resize((1055, 1055)).crop((15, 15, 1039, 1039)).save(other)
    done = command("calibrate", *pictures, other, "--fov", "12", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert [picture["left_out"] is None for picture in facts["pictures"]] == [True, True, True, False]
    assert facts["focal_length"] == pytest.approx(NARROW.pinhole.focal_length, rel=2e-4)


def test_few_stars_make_no_camera_file(pictures: list[Path], tmp_path: Path) -> None:
    corner, out = tmp_path / "corner.png", tmp_path / "camera.yaml"
    pixels = np.asarray(pillow.open(pictures[0])).copy()
    shown = json.loads(command("solve", pictures[0], "--fov", "12", "--json").stdout)["stars"][:8]
    mask = np.zeros(pixels.shape, dtype=bool)
    for star in shown:
        x, y = np.rint(star["point_px"]).astype(int)
        mask[max(0, y - 8) : y + 9, max(0, x - 8) : x + 9] = True
    dark = np.random.default_rng(3).normal(np.median(pixels), 11.0, pixels.shape)
    pillow.fromarray(np.where(mask, pixels, np.clip(dark, 0, 4000)).astype(np.uint16)).save(corner)
    done = command("calibrate", corner, "--fov", "12", "--out", out)
    assert done.returncode == 1
    assert "too few for a camera" in done.stderr
    assert not out.exists()


def test_pictures_without_stars_are_named_with_the_reason_and_exit_status_1(tmp_path: Path) -> None:
    path = tmp_path / "cloud.png"
    pillow.fromarray(np.random.default_rng(1).normal(90.0, 9.0, (256, 256)).astype(np.uint8)).save(path)
    done = command("calibrate", path)
    assert done.returncode == 1
    assert "cloud.png" in done.stderr


def test_a_file_that_is_there_is_not_overwritten(pictures: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "camera.yaml"
    out.write_text("camera: mine\n")
    done = command("calibrate", *pictures, "--out", out)
    assert done.returncode == 2
    assert "exists already" in done.stderr
    assert out.read_text() == "camera: mine\n"


def test_mirrored_pictures_give_the_lens_of_the_pictures_as_they_are(
    pictures: list[Path], tmp_path: Path
) -> None:
    """If two of three images are mirrored, the third image is excluded and named."""
    paths = [tmp_path / path.name for path in pictures]
    for number, (path, source) in enumerate(zip(paths, pictures, strict=True)):
        pixels = np.asarray(pillow.open(source))
        pillow.fromarray(pixels if number == 1 else np.ascontiguousarray(pixels[:, ::-1])).save(path)
    done = command("calibrate", *paths, "--fov", "12.3", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["mirrored"]
    assert [bool(each["left_out"]) for each in facts["pictures"]] == [False, True, False]
    assert "mirrored" in facts["pictures"][1]["left_out"]
    assert abs(facts["focal_length"] - NARROW.pinhole.focal_length) < 5.0 * facts["sigma"]["focal_length"]
