"""`flight horizon`: from a picture file to the way down, in numbers and in a picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pillow = pytest.importorskip("PIL.Image", reason="needs the extra `images`")

from sim_hal.earth_camera import nadir, render  # noqa: E402
from tests.ground.commands.in_process import command  # noqa: E402
from tests.sim_hal.earth_camera.scenes import limb_scene  # noqa: E402
from tests.studies.campaigns.nadir import camera_model  # noqa: E402

MODEL = camera_model()
SCENE = limb_scene(zenith=np.array([1.0, 0.0, 0.1]), sun=np.array([1.0, 0.6, 0.5]), texture=3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a picture of the limb, grey and in colour, one of the sky, and the camera."""
    folder = tmp_path_factory.mktemp("limb")
    frame = render(MODEL, SCENE, np.random.default_rng(1))
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
    # The command does not know the lens's distortion, up to 20 px at the corners; nor does its covariance.
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
    # The limb's line, all across the picture, and a ring for each edge.
    assert orange > 512


def test_a_picture_without_a_horizon_says_so_with_exit_status_1(folder: Path) -> None:
    done = command("horizon", folder / "sky.png", "--fov", "67", "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)["status"] == "no-horizon"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--fov", "170"], "1 to 150 degrees"),
        (["--fov", "67", "--altitude", "-3"], "not a positive number"),
        (["--fov", "67", "--altitude", "5"], "--altitude 5: the limb is seen as one from 50 km up"),
        (["--fov", "67", "--altitudes", "900", "300"], "altitudes of 900 to 300 km"),
        (["--fov", "67", "--altitude", "600", "--altitudes", "300", "900"], "not allowed with"),
        ([], "--fov --camera"),
        (["--camera", "config/step_demo.yaml"], "512 x 512 pixels, but the camera of"),
        (["--fov", "67", "--camera", "config/step_demo.yaml"], "not allowed with"),
    ],
)
def test_a_mistake_is_reported_with_exit_status_2(words: list[str], complaint: str, folder: Path) -> None:
    done = command("horizon", folder / "limb.png", *words)
    assert done.returncode == 2
    assert complaint in done.stderr
    assert "Traceback" not in done.stderr
