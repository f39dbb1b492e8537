"""Runs a few frames of the benchmark `render`."""

from __future__ import annotations

import numpy as np

from tests.studies.bench.render import rendered


def test_the_same_seed_renders_the_same_frames_some_of_which_show_the_earth() -> None:
    first, second, other = rendered(4, 3, 92.0), rendered(4, 3, 92.0), rendered(4, 4, 92.0)
    assert 0.0 < first.in_view <= 1.0
    assert first.ms > 0.0
    assert np.array_equal(first.frames, second.frames)
    assert not np.array_equal(first.frames, other.frames)
