"""What counts as a fault that met anything."""

from __future__ import annotations

import numpy as np
import pytest

from sim_hal.faults.catalogue import CATALOGUE
from tests.campaigns import fault_judgement

_TIMING = np.dtype([("time_ns", "<i8"), ("name", "S12"), ("execution", "<f8"), ("outcome", "S12")])


@pytest.mark.parametrize(
    ("at", "met"), [(5.0577, False), (5.049, True), (4.0, True), (5.0749, False), (5.2, False)]
)
def test_a_worker_meets_a_fault_only_with_a_job_that_was_begun_under_it(at: float, met: bool) -> None:
    """One plan, begun in the cycle at 5.05 s, 11 ms long, told in the next cycle."""
    jobs = np.array([(5_075_000_000, b"planner", 0.0112, b"done")], dtype=_TIMING)
    flown, kind = {"job_timing": jobs}, CATALOGUE["planner: exception"]
    assert fault_judgement._is_worker_met(flown, kind, at, 9.65) == met  # type: ignore[arg-type]
