"""Runs a slice of the campaign `unknown-body`: a KnightCube from a slow tumble to the start of its slew.

The limits are the requirements plus the scatter that even a filter with correct covariance has over few
samples.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from ground.campaigns.runner import Case
from tests.studies.campaigns import unknown_body

ROWS = ("orbit", "orbit-tumble", "orbit_3u", "orbit_3u-tumble")


def largest(count: int) -> float:
    """Return the mean square of `count` normal errors that a consistent filter exceeds once in 1,000 flights.

    The chi-square distribution is approximated by the formula of Wilson and Hilferty (1931).
    """
    spread = 2.0 / (9.0 * count)
    return (1.0 - spread + 3.09 * math.sqrt(spread)) ** 3


def test_a_flight_is_judged_by_phase_in_the_axes_of_body_and_star_camera(tmp_path: Path) -> None:
    given = {"name": "orbit", "seconds": 70.0, "speed": math.radians(1.0)}
    result = unknown_body.run(Case("slice", (3, 1), given))
    table = unknown_body.summarise([result], tmp_path)
    slew = table.facts["phases"]["orbit/slew"]
    count = round(3 * slew["stars_n"])
    assert count >= 9
    # The filter's errors in the samples of one slew are correlated, and count as one error of three axes.
    assert slew["stars_deg"] < 0.01 * math.sqrt(largest(3)), "0.01 deg rms is required"
    assert slew["body_claim"] > slew["camera_claim"], "the claim of the body contains that of the mounting"
    assert 1.0 / largest(count) < slew["camera_nees"] < largest(count), "1 is expected"
    assert slew["body_nees"] < largest(3), "the mounting has one error in all samples"
    flight = table.facts["flights"]["orbit"]
    assert (flight["restarts"], flight["beyond"], flight["excursion_s"]) == (0, 0.0, 0.0)
    assert flight["learned_refused"] == 0
    assert flight["fine_s"] < 15.0
    assert flight["attitudes"][0] >= 4
    assert flight["attitudes"][1] == 0
    assert flight["available"] >= 0.8


def test_the_beginnings_of_the_flights_are_flights_of_their_own() -> None:
    flights = {case.key: case for case in unknown_body.cases(2, 9)}
    assert sorted(flights) == sorted(f"{name}/{k}" for name in ROWS for k in range(2))
    short, whole = (flights[f"{name}/1"] for name in ("orbit-tumble", "orbit"))
    assert short.seed == whole.seed
    assert short.parameters["seconds"] < unknown_body.FLOWN["orbit"]


def test_samples_beyond_five_sigma_and_the_longest_excursion_are_counted(tmp_path: Path) -> None:
    part = {name: [4.0, 4e-6, 2e-6, 8.0] for name in ("body", "camera", "stars")}
    result = {
        "name": "orbit",
        "phases": dict.fromkeys(unknown_body.PHASES, part),
        "fine_s": 12.0,
        "excursions": {"samples": 1000.0, "beyond": 2.0, "longest_s": 0.1, "sigmas": 5.5},
        "restarts": 1,
        "learned_refused": 2,
        "refused": 3,
        "attitudes": [100, 2],
        "rates": [10, 1],
        "inertia": {"error": 0.002, "claim": 0.003, "nees": 0.8},
        "unobstructed": [50, 45],
        "longest_gap_s": 30.0,
    }
    facts = unknown_body.summarise([result, result], tmp_path).facts
    phase = facts["phases"]["orbit/tumble"]
    assert phase["body_nees"] == pytest.approx(2.0)
    assert phase["body_deg"] == pytest.approx(math.degrees(1e-3))
    flight = facts["flights"]["orbit"]
    assert flight["beyond"] == pytest.approx(0.002)
    assert flight["fine_s"] == 12.0
    assert flight["learned_refused"] == 4
    assert flight["attitudes"] == [200, 4]
    assert flight["available"] == pytest.approx(0.9)
