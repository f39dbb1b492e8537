"""Tests that a target is accepted only if it defines an attitude, and that each target has a text."""

from __future__ import annotations

import math

import pytest

from knightcube.errors import UsageError
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget

HALF = 0.5 * math.pi


def test_goals_keep_their_numbers_in_the_command_packet() -> None:
    """The numbers of the goals in command packets do not change.

    Recorded commands and ground databases use these numbers.
    """
    labels = ["nadir", "velocity", "sun", "inertial", "ground", "object"]
    assert [Goal(number).label for number in range(6)] == labels
    assert [Goal.named(label).value for label in labels] == list(range(6))
    with pytest.raises(UsageError, match="'moon' is not a pointing goal"):
        Goal.named("moon")


@pytest.mark.parametrize(
    ("goal", "numbers", "text"),
    [
        (Goal.NADIR, (), "nadir, roll free"),
        (Goal.INERTIAL, (0.0, 0.6, 0.0, 0.8), "inertial 0.0000 0.6000 0.0000 0.8000"),
        (Goal.INERTIAL, (0.0, 0.0, 0.0, 1.0009), "inertial 0.0000 0.0000 0.0000 1.0009"),
        (Goal.INERTIAL, (0.0, 0.0, 0.0, 0.9991), "inertial 0.0000 0.0000 0.0000 0.9991"),
        (Goal.GROUND, (HALF, 0.1), "ground latitude 90.0000, longitude 5.7296 deg, roll free"),
        (Goal.GROUND, (-HALF, -4.0), "ground latitude -90.0000, longitude -229.1831 deg, roll free"),
        (Goal.OBJECT, (), "object"),
        (Goal.OBJECT, (0.2, -HALF), "object near RA 11.4592, Dec -90.0000 deg"),
    ],
)
def test_a_sound_target_has_a_text(goal: Goal, numbers: tuple[float, ...], text: str) -> None:
    assert PointingTarget(goal, numbers).text == text


def test_a_roll_is_shown_in_degrees() -> None:
    assert PointingTarget(Goal.SUN, roll=HALF).text == "sun, roll 90 deg"
    assert (
        PointingTarget(Goal.GROUND, (0.0, 0.0), 0.0).text
        == "ground latitude 0.0000, longitude 0.0000 deg, roll 0 deg"
    )


@pytest.mark.parametrize(
    ("goal", "numbers", "roll", "message"),
    [
        (Goal.NADIR, (1.0,), None, "nadir takes 0 numbers, not 1"),
        (Goal.GROUND, 0.1, None, "ground: 0.1: give a sequence of numbers"),
        (Goal.INERTIAL, (0.0, 0.0, 1.0), None, "inertial takes 4 numbers, not 3"),
        ("sun", (), None, "'sun': give one of Goal.NADIR, Goal.VELOCITY"),
        (Goal.GROUND, (0.1,), None, "ground takes 2 numbers, not 1: latitude, longitude"),
        (Goal.GROUND, (0.1, 7.0), None, "longitude 401.07 deg must lie within -360 to 360 deg"),
        (Goal.OBJECT, (-7.0, 0.0), None, "right ascension -401.07 deg must lie within"),
        (Goal.SUN, (), 1e300, "roll .* deg must lie within -360 to 360 deg"),
        (Goal.OBJECT, (0.1,), None, "object takes 0 or 2 numbers, not 1"),
        (Goal.GROUND, (math.nan, 0.0), None, "must be finite"),
        (Goal.SUN, (), math.inf, "must be finite"),
        (Goal.INERTIAL, (0.0, 0.0, 0.0, 1.0011), None, "has length 1.0011"),
        (Goal.INERTIAL, (0.0, 0.0, 0.0, 0.9989), None, "has length 0.9989"),
        (Goal.INERTIAL, (0.0, 0.0, 0.0, 1.0), 0.0, "includes its roll"),
        (Goal.OBJECT, (), 0.1, "free roll"),
        (Goal.GROUND, (1.58, 0.0), None, "latitude 90.5273 deg: must be -90 to 90"),
        (Goal.OBJECT, (0.0, -1.58), None, "declination -90.5273 deg: must be -90 to 90"),
    ],
)
def test_a_target_that_defines_no_attitude_is_refused(
    goal: Goal, numbers: tuple[float, ...], roll: float | None, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        PointingTarget(goal, numbers, roll)
