"""The constants of `flight.link` are those of the record."""

from __future__ import annotations

from tests.support.recorded_constants import check_constants


def test_the_constants_are_as_recorded() -> None:
    check_constants(__file__)
