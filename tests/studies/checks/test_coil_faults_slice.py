"""A slice of campaign `coil-faults`: the faults that disturb the estimate most, at fixed seeds."""

from __future__ import annotations

import pytest

from tests.studies.campaigns.coil_faults import LONGEST_BEYOND, LONGEST_REFUSAL, SPAN, cases, run


@pytest.mark.parametrize(
    "key", [f"coil-x: open {SPAN} 0", f"coil-x: reversed {SPAN} 0", "bridge-z: a-high lasting 18"]
)
def test_a_broken_coil_misleads_the_estimate_for_less_than_a_quarter_of_a_second(key: str) -> None:
    (case,) = (case for case in cases(20, 1) if case.key == key)
    result = run(case)
    assert max(result["beyond_s"], result["beyond_after_end_s"]) < LONGEST_BEYOND
    assert (result["last_refusal_s"] or 0.0) <= LONGEST_REFUSAL
    assert result["beyond_before_s"] == 0.0
