"""Tests of the printed output of `knightcube solve` and `knightcube calibrate`."""

from __future__ import annotations

import argparse
import json
import math
import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import yaml

from ground.commands import calibrate, solve
from ground.commands.options import utc
from knightcube.astro.quaternion import attitude_matrix, normalise
from knightcube.errors import UsageError
from knightcube.vision.camera.lens import Lens, Pinhole
from knightcube.vision.lens_calibration import MIN_STARS, DeterminedLens, OmittedTerm, calibrate_determined
from knightcube.vision.lens_knowledge import MatchedFrame
from knightcube.vision.star_tracker import StarSolution, StarTracker
from sim_hal.star_camera import StarCameraModel
from tests.ground.commands.in_process import command
from tests.knightcube.vision.startracker.frames import sky_frame
from tests.support.recorded_results import check

CAMERA = StarCameraModel(columns=512, rows=512, field_of_view=float(np.radians(16.0)))


@lru_cache(maxsize=4)
def solved(streak_px: float, with_exposure: bool = True) -> StarSolution:
    """Return the solution of a frame."""
    one = sky_frame(np.random.default_rng([93, round(streak_px)]), streak_px, 0.2, CAMERA)
    exposure = one.exposure if with_exposure else None
    return StarTracker(16.0, 0.2).solve(
        one.pixels, exposure=exposure, rate=one.rate if with_exposure else None
    )


def numbers(text: str) -> list[float]:
    """Return the numbers in a text."""
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", text)]


def test_the_facts_of_a_solution_are_those_of_the_stars() -> None:
    solution = solved(0.0)
    found = solve.facts(solution, 0.25)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert (found["seconds"], found["points_found"]) == (0.25, len(solution.frame.points))
    assert found["field_of_view_sigma_deg"] == pytest.approx(math.degrees(solution.field_of_view_sigma))
    assert found["right_ascension_deg"] == solution.right_ascension_deg
    assert len(found["stars"]) == len(solution.stars)
    star = found["stars"][0]
    assert star["point_px"] == solution.stars.points[0].tolist()
    assert star["residual_px"] == solution.stars.residuals[0].tolist()
    assert star["magnitude"] == pytest.approx(float(solution.stars.magnitude[0]), abs=5e-4)
    assert (found["motion"], found["mirrored"]) == (None, False)
    check(__file__, "points", found)


def test_the_facts_of_streaks_have_the_motion() -> None:
    solution = solved(40.0)
    motion = solution.frame.motion
    assert motion is not None
    assert motion.rate is not None
    found = solve.facts(solution, 0.25)["motion"]
    assert found["turn_rad"] == pytest.approx((motion.rate * motion.exposure).tolist())
    assert found["rate_rad_s"] == motion.rate.tolist()
    assert found["streak_length_px"] == motion.length
    assert found["direction_of_time_known"] is True
    assert "rate_rad_s" not in cast(Any, solve._motion_facts(solved(40.0, False)))


def test_the_text_of_a_solution_has_its_numbers() -> None:
    solution = solved(0.0)
    lines = solve._text(solution, 0.25).splitlines()
    assert numbers(lines[1]) == [pytest.approx(solution.right_ascension_deg, abs=5e-5)]
    assert numbers(lines[2].replace("+", "")) == [pytest.approx(solution.declination_deg, abs=5e-5)]
    assert numbers(lines[3]) == [pytest.approx(solution.roll_deg, abs=5e-4)]
    sigma = np.degrees(np.sqrt(np.diag(solution.covariance))) * 3600.0
    assert numbers(lines[4])[1:] == [
        pytest.approx(value, abs=half) for value, half in zip(sigma, (5e-3, 5e-3, 5e-2), strict=True)
    ]
    per_pixel = math.degrees(1.0 / solution.frame.camera.focal_length) * 3600.0
    assert numbers(lines[5]) == [
        pytest.approx(solution.field_of_view_deg, abs=5e-5),
        pytest.approx(per_pixel, abs=5e-3),
    ]
    rms = float(np.sqrt(np.mean(solution.stars.residuals**2)))
    assert numbers(lines[6]) == [
        len(solution.stars),
        len(solution.frame.points),
        pytest.approx(rms, abs=5e-3),
    ]
    assert numbers(lines[7])[-1] == pytest.approx(solution.log10_false_alarm, abs=0.5)
    assert len(lines[8].split(",")) == min(8, len(solution.stars))
    assert numbers(lines[-1]) == [250.0]
    assert len(lines) == 10


def test_the_text_of_streaks_has_the_rate_or_asks_for_the_exposure() -> None:
    solution = solved(40.0)
    motion = solution.frame.motion
    assert motion is not None
    assert motion.rate is not None
    assert motion.covariance is not None
    length, rate = solve._motion_text(solution)
    assert numbers(length) == [pytest.approx(motion.length, abs=0.05)]
    spread = 1e3 * np.sqrt(np.diag(motion.covariance))
    expected = [value for pair in zip(1e3 * motion.rate, spread, strict=True) for value in pair]
    assert numbers(rate.replace("+- ", "").replace("+", "")) == pytest.approx(expected, abs=5e-5)
    (line,) = solve._motion_text(solved(40.0, False))
    assert "--exposure" in line
    assert solve._motion_text(solved(0.0)) == []


def test_a_picture_without_stars_has_a_reason() -> None:
    noise = np.random.default_rng(3).normal(100.0, 10.0, (256, 256)).astype(np.uint16)
    solution = StarTracker(16.0, 0.2).solve(noise)
    assert solve._text(solution, 0.1).splitlines()[1].endswith(solution.reason)
    found = solve.facts(solution, 0.1)
    assert set(found) == {"status", "reason", "shows", "points_found", "seconds"}
    assert found["reason"] == solution.reason


def test_a_date_without_a_zone_is_in_utc() -> None:
    assert utc("2026-11-21T20:15:00").isoformat() == "2026-11-21T20:15:00+00:00"
    assert utc("2026-11-21T20:15:00+01:00").isoformat() == "2026-11-21T19:15:00+00:00"
    with pytest.raises(argparse.ArgumentTypeError, match="yesterday"):
        utc("yesterday")
    with pytest.raises(argparse.ArgumentTypeError, match="give a time"):
        utc("0001-01-01T00:00:00+01:00")


def lens(omitted: bool = False) -> DeterminedLens:
    """Return a calibrated lens without some terms."""
    begun = Pinhole.from_field_of_view(1024, 1024, np.radians(20.0))
    truth = Lens(1024, 1024, 1.01 * begun.focal_length, (505.0, 520.0), -0.1, 0.05)
    rng, frames = np.random.default_rng(24), []
    for _ in range(4):
        attitude, points = normalise(rng.normal(size=4)), rng.uniform(0.0, 1023.0, (20, 2))
        directions = truth.unit_vectors(points) @ attitude_matrix(attitude)
        frames.append(MatchedFrame(points + 0.1 * rng.normal(size=(20, 2)), np.full(20, 0.1), directions))
    found = calibrate_determined(frames, begun)
    if omitted:
        terms = {
            "centre": OmittedTerm((1.0, 2.0), (3.0, 4.0), (0.0, 0.0)),
            "k2": OmittedTerm((0.01,), (0.02,), (0.0,)),
        }
        accuracy = {"focal_length": 1e-3, "distortion": 2e-3}
        found = replace(found, omitted=terms, accuracy=accuracy)
    return found


def pictures() -> list[tuple[Path, Any]]:
    """Return the calibration results of a used, an excluded and an unsolved image."""
    solution = SimpleNamespace(status=SimpleNamespace(value="solved"), matched=list(range(20)))
    return [
        (Path(name), SimpleNamespace(solution=solution, reason=reason, excluded=excluded))
        for name, reason, excluded in (("a", "", False), ("b", "odd", True), ("c", "dark", False))
    ]


def test_a_calibration_is_printed_with_its_errors() -> None:
    terms = lens()
    found, lines = terms.calibration, calibrate._text(terms, pictures()).splitlines()
    assert lines[:2] == ["b: excluded: odd", "c: not solved: dark"]
    assert numbers(lines[2]) == [1, 3, 20]
    assert numbers(lines[3]) == [
        pytest.approx(found.lens.focal_length, abs=5e-3), pytest.approx(found.sigma["focal_length"], abs=5e-3)
    ]  # fmt: skip
    field = 2.0 * math.degrees(math.atan(512.0 / found.lens.focal_length))
    (line,) = [line for line in lines if line.startswith("field")]
    assert numbers(line) == [pytest.approx(field, abs=5e-5)]
    (line,) = [line for line in lines if line.startswith("accuracy")]
    accuracy = [terms.accuracy[key] for key in ("focal_length", "centre", "distortion")]
    assert numbers(line) == pytest.approx([100 * accuracy[0], accuracy[1], 100 * accuracy[2]], abs=5e-3)
    assert numbers(lines[-2]) == pytest.approx([found.rms_before, found.rms_after], abs=5e-4)
    assert numbers(lines[-1])[:2] == [pytest.approx(found.chi_square, abs=0.5), found.degrees]
    facts = calibrate._facts(terms, pictures())
    assert json.loads(json.dumps(facts, allow_nan=False))["degrees_of_freedom"] == found.degrees
    assert [one["stars"] for one in facts["pictures"]] == [20] * 3
    check(__file__, "calibration", facts)


def test_terms_that_are_left_out_are_named() -> None:
    terms = lens(omitted=True)
    lines = calibrate._text(terms, pictures()).splitlines()
    (centre,) = [line for line in lines if line.startswith("centre:")]
    assert numbers(centre) == [1.0, 3.0, 2.0, 4.0]
    (k2,) = [line for line in lines if line.startswith("k2:")]
    assert numbers(k2)[1:] == [0.01, 0.02]
    assert not any(line.startswith("centre_x") for line in lines)


def test_the_camera_file_can_be_read_as_a_configuration() -> None:
    for omitted in (False, True):
        terms = lens(omitted)
        section = yaml.safe_load(calibrate._camera_section(terms))["camera"]
        truth = terms.calibration.lens
        assert (section["columns"], section["rows"]) == (1024, 1024)
        assert section["lens"]["focal_length"] == pytest.approx(truth.focal_length, abs=5e-5)
        assert section["lens"]["centre"] == pytest.approx(list(truth.centre), abs=5e-5)
        assert section["lens"]["k1"] == pytest.approx(truth.k1, abs=5e-9)
        assert ("k2" in section["lens"]) is ("k2" not in terms.omitted)
        assert section["accuracy"] == pytest.approx(terms.accuracy, rel=1e-2)


@pytest.mark.parametrize(
    ("stars", "undetermined", "status", "complaint"),
    [
        (MIN_STARS - 1, (), 1, f"{MIN_STARS - 1}"),
        (MIN_STARS, ("focal_length",), 1, "focal length"),
        (MIN_STARS, (), 0, ""),
    ],
)
def test_a_camera_is_written_only_from_enough_stars(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    stars: int,
    undetermined: tuple[str, ...],
    status: int,
    complaint: str,
) -> None:
    terms = lens()
    calibration = replace(terms.calibration, undetermined=undetermined)
    found = SimpleNamespace(
        mirrored=False,
        determined=replace(terms, calibration=calibration),
        images=[one for _, one in pictures()],
    )
    monkeypatch.setattr(type(calibration), "stars", property(lambda _: stars), raising=False)
    monkeypatch.setattr(calibrate, "calibrate_lens", lambda *_, **__: found)
    monkeypatch.setattr(calibrate, "_read", lambda paths: [(path, np.zeros((4, 4))) for path in paths])
    done = command("calibrate", "a", "b", "c", "--out", tmp_path / "camera.yaml")
    assert done.returncode == status
    assert (tmp_path / "camera.yaml").exists() is (status == 0)
    assert complaint in done.stderr


def test_pictures_that_are_not_solved_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    found = SimpleNamespace(determined=None, mirrored=False, images=[one for _, one in pictures()])
    monkeypatch.setattr(calibrate, "calibrate_lens", lambda *_, **__: found)
    monkeypatch.setattr(calibrate, "_read", lambda paths: [(path, np.zeros((4, 4))) for path in paths])
    done = command("calibrate", "a", "b", "c")
    assert (done.returncode, done.stderr) == (1, "knightcube: a: \nb: odd\nc: dark\n")


def test_pictures_of_two_sizes_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"a": (100, 120), "b": (100, 121)}
    monkeypatch.setattr(calibrate, "read_image", lambda path, upright: np.zeros(sizes[path.name], np.uint8))
    monkeypatch.setattr(calibrate, "check_size", lambda *_: None)
    assert len(calibrate._read([Path("a"), Path("a")])) == 2
    with pytest.raises(UsageError, match=r"121 x 100 .* 120 x 100"):
        calibrate._read([Path("a"), Path("b")])
