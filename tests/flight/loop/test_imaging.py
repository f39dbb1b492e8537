"""A partly overwritten frame is detected by its rows; a working camera's frames never are."""

from __future__ import annotations

import numpy as np
import pytest

from flight.loop.imaging import RepeatedRows
from knightcube.astro.arrays import Image

RNG = np.random.default_rng(8)


def exposed(noise: float = 10.0, dtype: str = "uint16") -> Image:
    """Return a frame of sky with read noise, in counts."""
    sky = RNG.poisson(20.0, (240, 320)) + RNG.normal(0.0, noise, (240, 320)) + 100.0
    return np.clip(sky, 0, np.iinfo(dtype).max).astype(dtype)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_frames_of_a_living_camera_are_of_one_piece(dtype: str) -> None:
    rows = RepeatedRows()
    assert [rows.look(exposed(dtype=dtype)) for _ in range(50)] == [0] * 50


@pytest.mark.parametrize("at", [10, 120, 235])
def test_a_frame_with_the_rows_of_an_earlier_one_is_torn(at: int) -> None:
    rows = RepeatedRows()
    before, between, now = exposed(), exposed(), exposed()
    rows.look(before)
    rows.look(between)
    assert rows.look(np.concatenate([now[:at], before[at:]])) == pytest.approx(32 * (240 - at) / 240, abs=1.5)
    assert rows.look(exposed()) == 0


def test_the_same_frame_again_is_not_torn_but_frozen() -> None:
    rows, frame = RepeatedRows(), exposed()
    rows.look(frame)
    assert rows.look(frame) == 0


def test_rows_without_noise_say_nothing() -> None:
    """A dark sensor of 8 bits gives rows of zeros, and hot pixels that never change."""
    rows = RepeatedRows()
    for number in range(4):
        frame = np.zeros((240, 320), dtype=np.uint8)
        frame[:, 40] = 255
        frame[200, 100 + number] = 60
        assert rows.look(frame) == 0
