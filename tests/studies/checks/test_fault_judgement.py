"""Which faults count as exercised."""

from __future__ import annotations

import numpy as np
import pytest

from sim_hal.faults.catalogue import CATALOGUE
from tests.studies.campaigns import fault_judgement

_TIMING = np.dtype([("time_ns", "<i8"), ("name", "S12"), ("execution", "<f8"), ("outcome", "S12")])


@pytest.mark.parametrize(
    ("at", "end", "met"),
    [
        (5.0577, 9.65, False),
        (5.03, 9.65, False),
        (5.02, 9.65, True),
        (4.0, 5.03, True),
        (4.0, 5.02, False),
        (5.2, 9.65, False),
    ],
)
def test_a_worker_meets_a_fault_only_with_a_job_that_was_begun_under_it(
    at: float, end: float, met: bool
) -> None:
    """One plan, begun at 5.025 s, reported after the modelled 0.05 s, however long it really took."""
    jobs = np.array([(5_075_000_000, b"planner", 0.0112, b"done")], dtype=_TIMING)
    flown, kind = {"job_timing": jobs}, CATALOGUE["planner: exception"]
    assert fault_judgement._is_worker_busy(flown, kind, at, end) == met  # type: ignore[arg-type]


@pytest.mark.parametrize(("current", "met"), [(0.008, False), (0.024, False), (0.03, True)])
def test_a_monitor_that_doubles_little_reports_nothing_wrong(current: float, met: bool) -> None:
    """Twice 8 mA is within the error of a reading of 8 mA, so no monitor can judge."""
    control = np.zeros(400, dtype=[("time_ns", "<i8"), ("current_written", "<f8", 3)])
    control["time_ns"] = np.arange(400) * 25_000_000
    control["current_written"][:, 0] = -current
    kind = CATALOGUE["monitor: wrong"]
    assert fault_judgement._is_exercised({"control": control}, kind, 3.0, 6.0) == met  # type: ignore[arg-type]
