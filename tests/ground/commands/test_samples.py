"""Tests that commands find the truth of images by `knightcube samples` and `knightcube camera --rate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("PIL.Image", reason="needs the extra `images`")

from knightcube.astro.quaternion import angle_between
from tests.ground.commands.in_process import command
from tests.support.places import DEMO


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the JSON object that `samples --json` prints."""
    done = command("samples", "--out", tmp_path_factory.mktemp("samples"), "--json")
    assert done.returncode == 0, done.stderr
    facts: dict[str, Any] = json.loads(done.stdout)
    return {**facts, "truth": json.loads(Path(facts["truth"]).read_text())}


def _tried(samples: dict[str, Any], name: str) -> dict[str, Any]:
    """Run the command that is printed for a sample image, and return its JSON output."""
    (line,) = [line for line in samples["try"] if line.startswith(f"{name} ")]
    done = command(*line.split(), "--json")
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def _within(error: np.ndarray[Any, Any], covariance: list[list[float]]) -> bool:
    return bool(error @ np.linalg.solve(np.array(covariance), error) < 25.0)


def test_the_stars_are_solved_where_they_are(samples: dict[str, Any]) -> None:
    found, truth = _tried(samples, "solve"), samples["truth"]["stars.png"]
    assert found["right_ascension_deg"] == pytest.approx(truth["right_ascension_deg"], abs=0.01)
    assert found["declination_deg"] == pytest.approx(truth["declination_deg"], abs=0.01)


def test_the_streaks_give_the_rate_and_the_satellite_among_them(samples: dict[str, Any]) -> None:
    found, truth = _tried(samples, "rate"), samples["truth"]["streaks.png"]
    assert _within(np.array(found["rate_rad_s"]) - truth["rate_rad_s"], found["covariance_rad2_s2"])
    assert found["streak_length_px"] == pytest.approx(truth["streak_px"], rel=0.1)
    (satellite,) = found["objects"]
    assert satellite["rate_among_stars_rad_s"] == pytest.approx(0.025, rel=0.05)


def test_the_limb_gives_the_nadir(samples: dict[str, Any]) -> None:
    found, truth = _tried(samples, "horizon"), samples["truth"]["limb.png"]
    off = np.degrees(np.arccos(np.dot(found["nadir_camera"], truth["nadir_camera"])))
    assert off < 3.0 * found["sigma_deg"]


def test_the_night_skies_calibrate_the_camera(samples: dict[str, Any]) -> None:
    found = _tried(samples, "calibrate")
    assert all(picture["left_out"] is None for picture in found["pictures"])
    focal_length = 0.5 * 768 / np.tan(np.radians(7.5))
    assert found["focal_length"] == pytest.approx(focal_length, rel=1e-4)


def test_every_picture_has_its_truth_and_a_place_that_cannot_be_is_refused(
    samples: dict[str, Any], tmp_path: Path
) -> None:
    assert {Path(path).name for path in samples["files"]} == set(samples["truth"])
    (tmp_path / "file").touch()
    done = command("samples", "--out", tmp_path / "file")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("camera") / "camera.yaml"
    text = DEMO.read_text(encoding="utf-8").replace("mounting:", "# mounting:")
    small = text.replace("columns: 1024", "columns: 480").replace("rows: 1024", "rows: 480")
    mounted = small.replace("  endpoint_bias", "  mounting: [0.5, 0.5, 0.5, 0.5]\n  endpoint_bias")
    path.write_text(mounted.replace("field_of_view_deg: 20.0", "field_of_view_deg: 10.0"), encoding="utf-8")
    return path


def test_frames_of_a_turning_camera_have_their_truth_beside_them(config: Path, tmp_path: Path) -> None:
    """The true rate of a frame is stated in camera axes, so it is independent of the camera's mounting."""
    rate = ["0.03", "0.02", "-0.01"]
    words = ["--exposure", "0.3", "--rate", *rate, "--count", "2", "--out", str(tmp_path / "turn.png")]
    done = command("camera", "--config", config, *words)
    assert done.returncode == 0, done.stderr
    truths = [json.loads((tmp_path / f"turn-{number}.json").read_text()) for number in (1, 2)]
    between = angle_between(np.array(truths[0]["attitude"]), np.array(truths[1]["attitude"]))
    # The second frame is triggered after the readout of the first frame (0.05 s). The readout is polled every
    # 5 ms.
    assert float(between) == pytest.approx(np.linalg.norm([0.03, 0.02, 0.01]) * 0.3525, rel=0.01)
    found = command(
        "rate", tmp_path / "turn-2.png", "--camera", config, "--exposure", "0.3", "--prior", *rate, "--json"
    )
    facts = json.loads(found.stdout)
    assert found.returncode == 0, facts
    assert _within(np.array(facts["rate_rad_s"]) - truths[1]["rate_rad_s"], facts["covariance_rad2_s2"])


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--rate", "3", "0", "0"], "--rate: 3 rad in the exposure: give at most 0.5"),
        (["--rate", "nan", "0", "0"], "nan is not a finite number"),
        (["--rate", "1", "0"], "expected 3 arguments"),
    ],
)
def test_a_rate_that_no_picture_shows_is_refused(words: list[str], complaint: str, config: Path) -> None:
    done = command("camera", "--config", config, *words)
    assert done.returncode == 2
    assert complaint in done.stderr


def test_a_real_camera_does_not_turn_by_itself(tmp_path: Path) -> None:
    text = (DEMO.parent / "testbed.yaml").read_text(encoding="utf-8")
    path = tmp_path / "real.yaml"
    path.write_text(
        text.replace("camera: none", "camera: {device: {driver: v4l2}, bits: 8}"), encoding="utf-8"
    )
    done = command("camera", "--config", path, "--rate", "0", "0", "0.01")
    assert done.returncode == 2
    assert "has a real camera" in done.stderr
