"""A term that the stars do not fix is in no lens, and a lens says truly how well it is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ground.calibration.terms import FixedTerms, fit_terms
from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Lens, Pinhole
from tests.ground.calibration.test_calibration import _begun, _frames, _lens


def _errors(found: FixedTerms, truth: Lens, begun: Pinhole) -> dict[str, float]:
    """Return the error of each key of `camera.accuracy`, as the schema describes it."""
    lens = found.calibration.lens
    square = (math.hypot(*begun.centre) / lens.focal_length) ** 2
    corner = [
        one.focal_length / lens.focal_length * (1.0 + square * (one.k1 + square * one.k2))
        for one in (lens, truth)
    ]
    off: FloatArray = np.array(lens.centre) - truth.centre
    return {
        "focal_length": lens.focal_length / truth.focal_length - 1.0,
        "centre": float(np.linalg.norm(off) / math.sqrt(2.0)),
        "distortion": corner[0] - corner[1],
    }


@pytest.mark.parametrize(("field_deg", "count", "stars"), [(20.0, 1, 40), (12.0, 1, 15), (20.0, 3, 20)])
def test_the_accuracy_of_a_lens_is_that_of_its_errors(field_deg: float, count: int, stars: int) -> None:
    """Terms that were left out count: what they would have changed is part of the error claimed."""
    rng, begun = np.random.default_rng(61), _begun(field_deg)
    ratios: dict[str, list[float]] = {"focal_length": [], "centre": [], "distortion": []}
    for _ in range(12):
        truth = _lens(rng, begun)
        found = fit_terms(_frames(rng, truth, count, stars)[0], begun)
        errors = _errors(found, truth, begun)
        for name, sigma in found.accuracy.items():
            ratios[name].append(errors[name] / sigma)
    for name, values in ratios.items():
        assert len(values) >= 8, name
        assert 0.3 < np.sqrt(np.mean(np.square(values))) < 1.9, name


def test_a_term_that_the_stars_do_not_fix_is_none_of_the_lens_whatever_the_fit_makes_of_it() -> None:
    """The case of the field: a narrow picture whose k2 comes out at half its prior, and means nothing."""
    rng, begun = np.random.default_rng(62), _begun(6.0)
    for _ in range(5):
        truth = _lens(rng, begun)
        found = fit_terms(_frames(rng, truth, 2, 20)[0], begun)
        gone = found.left_out["k2"]
        assert found.calibration.lens.k2 == pytest.approx(0.0, abs=1e-6)
        assert gone.sigmas[0] > 1.0
        for name, left in found.left_out.items():
            assert name == "centre" or left.sigmas[0] > min(0.5, abs(left.values[0])), name
        assert "centre" not in found.accuracy or "centre" not in found.left_out


def test_terms_that_the_stars_fix_all_stay() -> None:
    rng, begun = np.random.default_rng(63), _begun(40.0)
    truth = Lens(1024, 1024, 1.01 * begun.focal_length, (520.0, 505.0), -0.2, 0.08)
    found = fit_terms(_frames(rng, truth, 6, 40)[0], begun)
    assert found.left_out == {}
    assert found.calibration.lens.k2 == pytest.approx(0.08, abs=0.01)
    assert set(found.accuracy) == {"focal_length", "centre", "distortion"}


def test_a_lens_without_distortion_is_given_none_and_the_axis_of_one_narrow_frame_is_the_middle() -> None:
    rng, begun = np.random.default_rng(64), _begun(3.0)
    found = fit_terms(_frames(rng, Lens.of(begun), 1, 15, noise=0.3)[0], begun)
    assert set(found.left_out) == {"k1", "k2", "centre"}
    lens = found.calibration.lens
    assert (*lens.centre, lens.k1, lens.k2) == pytest.approx((511.5, 511.5, 0.0, 0.0), abs=2e-3)
    assert "centre" not in found.accuracy, "nobody knows more of the axis than before"
