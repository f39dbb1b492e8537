"""Tests of `knightcube index`, which makes a star index for a mission's camera."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from knightcube.vision.startracker.attitude_fit import MatchStatus
from knightcube.vision.startracker.index import load
from knightcube.vision.startracker.lost_in_space import identify
from tests.ground.commands.in_process import command
from tests.support.star_lists import ListKind, draw


def test_the_index_of_a_camera_serves_its_field_and_is_smaller(tmp_path: Path) -> None:
    path = tmp_path / "mission.index"
    done = command("index", "--fov", "20", "--faintest", "6.0", "--out", path, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    sky = load(path)
    assert facts["stars"] == len(sky.stars) < 6000
    assert facts["triangles"] == len(sky.triangles)
    for seed in range(5):
        drawn = draw(
            ListKind(field_deg=20.0, noise_px=0.3, false_stars=2), sky.stars, np.random.default_rng(seed)
        )
        found = identify(drawn.field(), sky)
        assert found.status is MatchStatus.IDENTIFIED
        matched = found.star >= 0
        assert np.mean(found.star[matched] == drawn.star[matched]) > 0.8


def test_a_camera_of_a_configuration_gives_field_and_resolution(tmp_path: Path) -> None:
    path = tmp_path / "mission.index"
    done = command("index", "--camera", "step_demo", "--faintest", "4.0", "--out", path)
    assert done.returncode == 0, done.stderr
    assert "triangles" in done.stdout
    assert 300 < len(load(path).stars) < 700


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--fov", "1"), "2 to 120 deg"),
        (("--fov", "20", "--faintest", "nan"), "finite"),
        (("--fov", "20", "--faintest", "-9"), "stars to V -9"),
        (("--fov", "20", "--faintest", "4", "--out", "/proc/nowhere/x.index"), "cannot be written"),
    ],
)
def test_wrong_use_is_explained(arguments: tuple[str, ...], complaint: str, tmp_path: Path) -> None:
    out = () if "--out" in arguments else ("--out", str(tmp_path / "x.index"))
    done = command("index", *arguments, *out)
    assert done.returncode == 2
    assert complaint in done.stderr
