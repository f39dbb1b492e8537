"""Foregrounds and defects on a frame of stars: a slice of the bench `foregrounds`."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.vision.frame.regions import are_hot
from tests.studies.bench.foregrounds import found_boresight, photographed, rendered, rows_of, spoilt_scene
from tests.studies.bench.sky import PHOTOGRAPHS, angle_arcsec

_KINDS = ("bright third", "stripes", "leaves", "hot 1 %")


@pytest.mark.parametrize("kind", _KINDS)
def test_a_frame_with_a_foreground_or_defects_is_solved(kind: str) -> None:
    (scene,) = rendered(1, 0.0)
    spoilt = spoilt_scene(scene, kind, 0)
    found = found_boresight(spoilt)
    assert found is not None
    assert angle_arcsec(found, scene.boresight) < 60.0


@pytest.mark.skipif(not PHOTOGRAPHS.is_dir(), reason="the photographs of ../shared/data/sky are missing")
def test_photographs_with_a_foreground_or_defects_are_solved_and_never_wrongly() -> None:
    """Before noise was measured by block and hot pixels were replaced, 1 of 8 was right."""
    chosen = [s for s in photographed(PHOTOGRAPHS) if s.pixels.size < 800_000][:2]
    rows = rows_of(chosen, ("bright third", "hot 1 %"))
    assert sum(row["right"] for row in rows) >= 3
    assert sum(row["wrong"] for row in rows) == 0


def test_one_or_two_bright_pixels_are_hot_and_a_sharp_star_is_not() -> None:
    noise = np.ones(3)
    one, two, star = np.zeros(9), np.zeros(9), np.array([3.0, 12, 3, 12, 50, 12, 3, 12, 3])
    one[4], two[[4, 5]] = 50.0, (50.0, 40.0)
    assert are_hot(np.stack([one, two, star], axis=1), noise).tolist() == [True, True, False]
