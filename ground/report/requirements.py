"""Figures beside their bounds: the thesis's, and the requirements that a configuration states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from flight.schema.orbit import OrbitConfig

Object = dict[str, Any]


def required(
    config: OrbitConfig, detumbling: Object | None, knowledge: Object | None, pointing: Object | None
) -> list[Object]:
    """Return each figure that `requirements` bounds, with its verdict."""
    asked = config.requirements
    periods = detumbling["periods"] if detumbling else []
    slow = [one["duration_s"] if one["slowed"] else math.inf for one in periods[:1]]
    rows = [("slow after", slow, asked.slow_within, "s")]
    if knowledge is not None:
        slowed_at = [one["begin_s"] + one["duration_s"] for one in periods[:1] if one["slowed"]]
        fine_at = knowledge["fine_after_s"]
        fine = [math.inf if math.isnan(fine_at) else max(0.0, fine_at - at) for at in slowed_at]
        known = [math.degrees(knowledge["with_stars_error_rms_rad"])]
        rows.append(("attitude fine after the braking", fine, asked.fine_within, "s"))
        rows.append(("attitude known with stars, rms", known, asked.knowledge_deg, "deg"))
    for aim in pointing["targets"] if pointing else []:
        off = [math.degrees(aim["axis_rms_rad"])]
        rows.append((f"pointing to {aim['target']}, rms", off, asked.pointing_deg, "deg"))
    return [judge(name, values, limit, unit) for name, values, limit, unit in rows if limit is not None]


def judge(quantity: str, values: Sequence[float], limit: float, unit: str) -> Object:
    """Return the largest of `values`, NaN left out, with its verdict: "pass", "miss", "unknown" if none."""
    known = [value for value in values if not math.isnan(value)]
    worst = max(known, default=math.nan)
    within = worst <= limit * (1.0 + 1e-9)
    verdict = ("pass" if within else "miss") if known else "unknown"
    return {"quantity": quantity, "worst": worst, "limit": limit, "unit": unit, "verdict": verdict}
