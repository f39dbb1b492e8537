"""Runs a small slice of the campaigns `mismatch` and `vibration`, and tests their renderer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ground.campaigns.runner import Case, Result
from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import EXACT, Pinhole
from tests.studies.campaigns import mismatch
from tests.studies.campaigns.imperfections import IMPERFECTIONS
from tests.support.supersampled import Optics, Sky, coma, disc, gaussian, halo, light, moffat, through_lens

_SEED = 20_261_123
_PINHOLE = Pinhole.from_field_of_view(96, 80, np.radians(4.0))
_STILL = np.array([0.0, 0.0, 0.0, 1.0])


def _rendered(optics: Optics, star: FloatArray, electrons: float = 1000.0) -> FloatArray:
    sky = Sky(star[None], np.array([electrons]))
    rng = np.random.default_rng(1)
    return light(_PINHOLE, optics, sky, lambda times: np.tile(_STILL, (len(times), 1)), 1.0, 0.0, rng)


def _moments(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    row, column = np.indices(image.shape)
    share = image / image.sum()
    middle = np.array([np.sum(share * column), np.sum(share * row)])
    dx, dy = column - middle[0], row - middle[1]
    return middle, np.array([np.sum(share * dx * dx), np.sum(share * dx * dy), np.sum(share * dy * dy)])


def test_a_star_at_rest_has_its_place_its_light_and_the_point_spreads_moments() -> None:
    """The point spread is a rotated ellipse, convolved with a square pixel.

    The renderer distributes the light of a point over neighbouring cells. The width of a single image depends
    on the position of the point within its cell; the mean over positions does not.
    """
    turned = np.array([[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]])
    spread = turned @ np.diag([1.3, 1.0 / 1.3]) @ turned.T
    expected = np.array([spread[0, 0] + 1.0 / 12.0, spread[0, 1], spread[1, 1] + 1.0 / 12.0])
    places = np.random.default_rng(_SEED).uniform(40.0, 41.0, (40, 2))
    moments = []
    for place in places:
        image = _rendered(Optics((gaussian(1.0, 1.3, 0.6),)), _PINHOLE.unit_vectors(place[None])[0])
        assert image.sum() == pytest.approx(1000.0, rel=1e-4)
        middle, moment = _moments(image)
        assert middle == pytest.approx(place, abs=0.01)
        moments.append(moment)
    assert np.mean(moments, axis=0) == pytest.approx(expected, abs=0.004)


@pytest.mark.parametrize("spread", [moffat(1.0, 2.5), halo(1.0, 0.15, 4.0), coma(0.9, 4.0, 0.6), disc(4.0)])
def test_every_point_spread_keeps_the_light(spread: object) -> None:
    image = _rendered(Optics((spread,), radius=12.0), np.array([0.0, 0.0, 1.0]))  # type: ignore[arg-type]  # spreads
    assert image.sum() == pytest.approx(1000.0, rel=1e-3)


def test_a_star_beyond_the_edge_lights_the_pixels_within_reach_of_its_point_spread() -> None:
    beyond, inside = _PINHOLE.unit_vectors(np.array([[-1.3, 44.6], [38.7, 44.6]]))
    at_edge, whole = _rendered(Optics(), beyond), _rendered(Optics(), inside)
    assert at_edge.sum() > 100.0
    assert at_edge[:, :12] == pytest.approx(whole[:, 40:52], abs=0.01)


def test_distortion_moves_the_corner_by_its_share_and_the_axis_moves_all() -> None:
    corner = _PINHOLE.unit_vectors(np.array([[-0.5, -0.5]]))
    ideal = through_lens(_PINHOLE, Optics(), corner)[0]
    away = ideal - np.array(_PINHOLE.centre)
    stretched = through_lens(_PINHOLE, Optics(distortion=0.01), corner)[0] - ideal
    assert stretched == pytest.approx(0.01 * away, rel=0.01)
    shifted = through_lens(_PINHOLE, Optics(offset=(4.0, -3.0)), corner)[0] - ideal
    assert shifted == pytest.approx([4.0, -3.0])


def test_cases_cover_every_imperfection_at_both_turns_and_do_not_depend_on_how_many_are_run() -> None:
    many = mismatch.cases(2, _SEED)
    assert {(case.parameters["row"], case.parameters["percent"]) for case in many} == {
        (row, percent) for row in IMPERFECTIONS for percent in (10.0, 30.0)
    }
    assert mismatch.cases(1, _SEED) == [case for case in many if case.key.endswith(" 0")]
    assert mismatch.vibration_cases(2, _SEED) == mismatch.vibration_cases(4, _SEED)[:2]


def test_vibrations_have_every_exposure_amplitude_and_shape() -> None:
    shaking = [case.parameters for case in mismatch.vibration_cases(64, _SEED)]
    assert len({one["row"] for one in shaking}) == 4
    assert {one["shape"] for one in shaking} == set(mismatch.SHAPES)
    for shape in mismatch.SHAPES:
        wave = mismatch.wave(shape, 10.0, 0.3, np.random.default_rng(1))(np.linspace(-0.5, 0.5, 1001))
        assert 0.2 < float(np.sqrt(np.mean(wave**2))) < 0.8


def _case(row: str, run: int) -> Case:
    return next(c for c in mismatch.cases(run + 1, _SEED) if c.key == f"{row} 10 {run}")


@pytest.mark.slow
def test_a_frame_that_a_median_filtered_is_not_confidently_wrong() -> None:
    result = mismatch.run(_case("median 3 x 3", 0))
    assert result["nees"] is None or result["nees"] < mismatch.WRONG_SIGMAS**2


@pytest.mark.slow
def test_an_axis_5_px_off_is_within_what_is_claimed_unless_the_lens_is_called_exact() -> None:
    case, imperfection = _case("axis 5 px off", 2), IMPERFECTIONS["axis 5 px off"]
    pixels, rate = mismatch.expose(case, imperfection)
    believed: list[Result] = [
        mismatch.judge(case, pixels, rate, replace(imperfection, known=known))
        for known in ({}, {"knowledge": EXACT})
    ]
    assert believed[0]["nees"] < mismatch.WRONG_SIGMAS**2 < believed[1]["nees"]


@pytest.mark.slow
def test_an_unspecified_distortion_is_fitted_and_hardly_changes_the_rate() -> None:
    """The distortion is 1 % at the corner.

    If the distortion were corrected only after the fit, the rate error would be up to 1.5 %.
    """
    for run in range(3):
        case = next(c for c in mismatch.cases(run + 1, _SEED) if c.key == f"distortion 1 % 30 {run}")
        result = mismatch.run(case)
        assert result["nees"] < mismatch.WRONG_SIGMAS**2
        assert result["share"] < 0.004
        assert result["claimed"] < 0.004


@pytest.mark.slow
def test_an_unspecified_elongated_point_spread_is_refused_on_short_streaks() -> None:
    """A body that vibrates fast along one axis causes the same streaks with other end points."""
    result = mismatch.run(_case("ellipse 1:2 turned", 0))
    assert result["nees"] is None


@pytest.mark.slow
def test_a_body_that_shakes_is_refused_or_within_what_is_claimed() -> None:
    shaking = {"row": "0.2 s", "percent": 10.0, "exposure": 0.2, "theta": 70.0, "frequency": 20.0}
    result = mismatch.vibration_run(Case("a", (_SEED, 1), {**shaking, "amplitude": 2.0}))
    assert result["nees"] is None or result["nees"] < mismatch.WRONG_SIGMAS**2


def test_the_summary_counts_what_is_beyond_its_sigmas_and_names_the_worst(tmp_path: Path) -> None:
    answer = {
        "row": "none",
        "percent": 10.0,
        "nees": 3.0,
        "share": 0.001,
        "claimed": 0.001,
        "milliseconds": 1.0,
    }
    results = [answer, {**answer, "nees": 49.0, "share": 0.02}, {**answer, "nees": None}]
    summary = mismatch.summarise(results, tmp_path)
    assert (summary.facts["all"]["beyond_sigmas"], summary.facts["all"]["beyond_share"]) == (1, 1)
    assert (summary.facts["all"]["answers"], summary.facts["all"]["frames"]) == (2, 3)
    assert summary.facts["worst"][0]["nees"] == 49.0
