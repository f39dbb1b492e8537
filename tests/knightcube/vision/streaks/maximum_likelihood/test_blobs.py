"""Regions of light are connected as an independent labelling connects them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from knightcube.vision.streaks.maximum_likelihood.blobs import find_blobs
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame

_SHAPE = (60, 90)
_LEAST = 12


def _frame(mask: np.ndarray) -> ExposedFrame:
    """Return a frame whose 3 x 3 sums exceed the threshold where `mask` (rows, columns) says."""
    light = np.where(mask, 100.0, 0.0).astype(np.float32).reshape(-1)
    light += mask.reshape(-1) * np.arange(mask.size, dtype=np.float32) % 7
    nothing = np.zeros(mask.size, dtype=np.bool_)
    counts = np.zeros(mask.size, dtype=np.uint16)
    return ExposedFrame(_SHAPE, light, light, np.ones_like(light), counts, 4095.0, nothing, 1.0, 0)


@pytest.mark.parametrize("share", [0.02, 0.2, 0.35, 0.45, 0.7])
def test_regions_are_those_of_an_independent_labelling(share: float) -> None:
    """Eight-connected, at every density: sparse, near percolation, and all in one piece."""
    rng = np.random.default_rng(5)
    mask = np.zeros(_SHAPE, dtype=np.bool_)
    mask[1:-1, 1:-1] = rng.random((_SHAPE[0] - 2, _SHAPE[1] - 2)) < share
    labels, _ = ndimage.label(mask, structure=np.ones((3, 3), dtype=np.int64))
    area = np.bincount(labels.reshape(-1))[1:]
    frame = _frame(mask)
    found = find_blobs(frame, 4.5, 10_000)
    assert len(found) == np.count_nonzero(area >= _LEAST)
    for region in range(len(found)):
        mine = found.owner == region
        theirs = labels[found.row[mine], found.column[mine]]
        assert np.all(theirs == theirs[0])
        assert np.count_nonzero(mine) == area[theirs[0] - 1]
    assert np.all(np.diff(found.flux) <= 0.0)


def test_a_frame_without_light_has_no_regions() -> None:
    """None at all, and nothing is raised."""
    assert len(find_blobs(_frame(np.zeros(_SHAPE, dtype=np.bool_)), 4.5, 48)) == 0
