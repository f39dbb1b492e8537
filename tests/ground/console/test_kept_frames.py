"""Tests of stored frames on the page: each is a PNG that Pillow reads, with the objects that were found."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from ground.console.surroundings import FrameFolder, binned, pixels_of, png, stretched
from knightcube.astro.arrays import Image
from knightcube.vision.camera.images import portable_grey_map

FACTS = {"exposure_s": 0.2, "star_points": [[3.0, 4.5]], "object_points": [], "rate_rad_s": None}


def test_the_picture_is_read_by_another_program(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image", reason="needs the extra images")
    levels = np.arange(7 * 5, dtype=np.uint8).reshape(7, 5)
    with image.open(io.BytesIO(png(levels))) as opened:
        assert opened.mode == "L"
        assert np.array_equal(np.asarray(opened), levels)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_frame_that_was_kept_comes_back_with_what_was_found(tmp_path: Path, kind: type) -> None:
    pixels: Image = np.random.default_rng(1).integers(0, 200, (30, 40)).astype(kind)
    data = portable_grey_map(pixels, FACTS)
    assert np.array_equal(pixels_of(data), pixels)
    (tmp_path / "frame-00000007.pgm").write_bytes(data)
    folder = FrameFolder(tmp_path)
    assert folder.facts(7) == {**FACTS, "columns": 40, "rows": 30}
    assert (folder.picture(7) or b"")[:4] == b"\x89PNG"
    assert (folder.facts(8), folder.picture(8), FrameFolder(None).facts(7)) == (None, None, None)


@pytest.mark.parametrize("cut", [3, 20, 60, -1])
def test_a_frame_cut_short_is_none(tmp_path: Path, cut: int) -> None:
    data = portable_grey_map(np.ones((8, 8)), FACTS)
    (tmp_path / "frame-00000001.pgm").write_bytes(data[:cut])
    assert FrameFolder(tmp_path).picture(1) is None
    assert FrameFolder(tmp_path).facts(1) is None


def test_a_faint_star_shows_beside_a_bright_one() -> None:
    pixels = np.random.default_rng(2).normal(100.0, 5.0, (1300, 1300))
    pixels[200:206, 300:306] += 20_000.0
    pixels[900:906, 700:706] += 60.0
    small = stretched(binned(pixels))
    assert small.shape == (433, 433)
    assert small[67, 100] == 255
    assert small[301, 234] > np.percentile(small, 99.0)
