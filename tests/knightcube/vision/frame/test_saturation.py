"""The step between the counts of a frame."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.vision.frame.saturation import in_steps

_EIGHT_BITS = np.random.default_rng(1).normal(20.0, 2.0, (64, 96)).astype(np.uint8)


@pytest.mark.parametrize(("step", "offset"), [(257, 0), (16, 5), (4, 3)])
def test_counts_that_share_a_step_come_back_in_steps(step: int, offset: int) -> None:
    pixels = _EIGHT_BITS.astype(np.uint16) * np.uint16(step) + np.uint16(offset)
    found, *lattice = in_steps(pixels)
    assert np.array_equal(found, _EIGHT_BITS)
    assert lattice == [step, offset]
    assert found.dtype == pixels.dtype


def test_a_few_repaired_pixels_between_the_steps_go_to_the_nearest() -> None:
    pixels = _EIGHT_BITS.astype(np.uint16) * np.uint16(257)
    pixels[3, 5] = 20 * 257 + 200
    found, step, _ = in_steps(pixels)
    assert step == 257
    assert found[3, 5] == 21


def test_counts_without_a_common_step_and_constant_ones_stay_as_they_are() -> None:
    for pixels in (_EIGHT_BITS, np.full((64, 64), 7, np.uint16)):
        found, step, offset = in_steps(pixels)
        assert found is pixels
        assert (step, offset) == (1, 0)
