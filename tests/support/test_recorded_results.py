"""Tests of the comparison of results with their records, with and without compiled functions."""

from __future__ import annotations

import pytest

from tests.support.recorded_results import COMPILED_TOLERANCE, OTHER_TOLERANCE, TOLERANCE, ZERO, unlike


@pytest.mark.parametrize(
    ("change", "compiled", "lines"),
    [
        ({"flux": 100.0 * (1.0 + 0.5 * OTHER_TOLERANCE)}, False, 0),
        ({"flux": 100.0 * (1.0 + 2.0 * OTHER_TOLERANCE)}, False, 1),
        ({"flux": 100.0 * (1.0 + 0.5 * COMPILED_TOLERANCE)}, True, 0),
        ({"flux": 100.0 * (1.0 + 2.0 * COMPILED_TOLERANCE)}, True, 1),
        ({"rate": {"mean": 1.0, "rms": 1.0 + 0.5 * TOLERANCE}}, False, 0),
        ({"rate": {"mean": 1.0, "rms": 1.0 + 5.0 * TOLERANCE}}, False, 1),
        ({"rate": {"mean": 1.0, "rms": 1.0 + 5.0 * TOLERANCE}}, True, 1),
        ({"used": 8}, True, 1),
    ],
)
def test_values_other_than_answers_have_a_larger_tolerance(
    change: dict[str, object], compiled: bool, lines: int
) -> None:
    record = {"flux": 100.0, "used": 7, "rate": {"mean": 1.0, "rms": 1.0}}
    assert len(unlike(record, {**record, **change}, TOLERANCE, ZERO, compiled)) == lines
