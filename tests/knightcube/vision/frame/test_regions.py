"""Regions of pixels against scipy's labels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from knightcube.astro.arrays import BoolArray
from knightcube.vision.frame.regions import label_pixels

Y, X = np.indices((200, 150))
RNG = np.random.default_rng(0)
SPIRAL = (np.hypot(Y - 100, X - 75) + np.arctan2(Y - 100, X - 75) * 6.0 / np.pi) % 12.0 < 4.0


@pytest.mark.parametrize(
    "mask",
    [
        np.zeros((200, 150), dtype=bool),
        np.ones((200, 150), dtype=bool),
        *(RNG.random((200, 150)) < share for share in (0.001, 0.1, 0.4, 0.6)),
        (X + Y) % 40 < 3,
        (X % 7 < 2) | (RNG.random((200, 150)) < 0.02),
        SPIRAL,
        X % 149 == 0,  # the ends of rows touch nothing
    ],
)
def test_regions_are_scipys_numbered_by_their_first_pixels(mask: BoolArray) -> None:
    pixel = np.flatnonzero(mask)
    number, count = label_pixels(pixel, mask.shape[1])
    labels, wanted = ndimage.label(mask, np.ones((3, 3)))
    own = labels.ravel()[pixel]
    _, first, group = np.unique(own, return_index=True, return_inverse=True)
    assert count == wanted
    np.testing.assert_array_equal(number, np.argsort(np.argsort(first))[group])
