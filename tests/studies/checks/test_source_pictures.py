"""Tests that one command draws the figures of the thesis with the content of the thesis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Picture

from knightcube.reference.corner_streaks import DETECTOR_NAMES, StreakSettings
from knightcube.vision.objects.streak_ends import measure_streaks, segment_frame
from sim_hal.star_camera import StarCameraModel
from tests.studies import source_pictures
from tests.studies.campaigns.rso import draw_sky
from tests.support.scenes import FIELD


@pytest.mark.slow
def test_one_command_draws_every_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The results of the campaign are artificial, and the flight is shortened to 12 s."""
    figures: dict[str, float | None] = {"magnitude": 0.003, "across_px": None}
    cell: dict[str, Any] = {"theta": 45, "percent": 10}
    cell |= dict.fromkeys(DETECTOR_NAMES, figures)
    monkeypatch.setattr(source_pictures, "accuracies", lambda *_: [cell])
    short = source_pictures.flown_simulation(12.0)
    monkeypatch.setattr(source_pictures, "flown_simulation", lambda: short)
    assert source_pictures.main(["--out", str(tmp_path)]) == 0
    paths = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert {path.stem for path in paths} == {*source_pictures.PICTURES, source_pictures.ACCURACIES}
    for path in paths:
        with Picture.open(path) as picture:
            pixels = np.asarray(picture.convert("L"))
        assert pixels.shape[1] >= 800
        assert np.ptp(pixels) == 255


@pytest.mark.slow
def test_every_indicator_has_the_object_as_its_outlier() -> None:
    """The thesis states deviations of 3.6, 3.5 and 3.6 sigma for its object of magnitude 1."""
    camera = StarCameraModel(field_of_view=FIELD)
    generator = np.random.default_rng(source_pictures.OBJECT_SEED)
    sky = draw_sky(camera, generator, tracked=False)
    pixels = sky.frame(camera, source_pictures.OBJECT_MAGNITUDE, generator)
    ends = measure_streaks(segment_frame(pixels, StreakSettings()), StreakSettings()).endpoints
    item = int(np.linalg.norm(ends.mean(axis=1) - sky.path.mean(axis=0), axis=1).argmin())
    shown = source_pictures.indicators(ends, sky.rate, camera.pinhole)
    assert [label for label, _ in shown] == ["slope", "length, px", "OLAE residual"]
    for _, values in shown:
        away = np.abs(values - values.mean()) / values.std()
        assert away[item] > 3.5
        assert np.delete(away, item).max() < 1.0
