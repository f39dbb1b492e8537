"""Runs slices of the campaigns `coil-faults` and `unlike-inertia` at fixed seeds."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.studies.campaigns import unlike_inertia
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


@pytest.mark.parametrize(
    "key",
    ["orbit tumble reversed 0", "orbit_3u tumble open 0", "orbit slow reversed 1"],
)
def test_a_broken_coil_of_an_unlike_body_is_handled_soon_and_no_healthy_coil_is_judged(
    key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind in unlike_inertia.DURATIONS:
        seconds = unlike_inertia.TEST_INTERVAL if "slow" in kind else unlike_inertia.SOON
        monkeypatch.setitem(unlike_inertia.DURATIONS, kind, seconds)
    (case,) = (case for case in unlike_inertia.cases(2, 7) if case.key == key)
    result = unlike_inertia.run(case)
    assert result["handled_s"] is not None
    slow = " slow " in key
    assert result["handled_s"] <= unlike_inertia.SOON + (2.0 * unlike_inertia.TEST_INTERVAL if slow else 0.0)
    facts = unlike_inertia.summarise([result], tmp_path).facts
    assert facts["with_healthy_isolated"] == facts["with_healthy_suspected"] == 0
    assert facts["with_healthy_corrected"] == 0
    assert facts[f"{key[:-2]}: handled"] == 1
