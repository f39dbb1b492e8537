"""How the loop, its workers and its log fared: rate groups, cycles, jobs, plans, events, integrity."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from flight.link.modes import STEERING, Mode
from flight.link.telemetry.packets import PacketArray, to_text
from flight.loop.fdir.facts import FACTS, StreamState
from ground.report.signals import seconds
from ground.telemetry.reader import Run
from knightcube.astro.arrays import FloatArray

Object = dict[str, Any]


def rate_groups(packets: PacketArray) -> list[Object]:
    """Return the final counters of each rate group, fastest first."""
    last = {to_text(row["name"]): row for row in packets}
    groups = [
        {
            "name": name,
            "period_s": float(row["period"]),
            "cycles": int(row["cycles"]),
            "slips": int(row["slips"]),
            "overruns": int(row["overruns"]),
            "mean_s": float(row["mean"]),
            "max_s": float(row["max"]),
        }
        for name, row in last.items()
    ]
    return sorted(groups, key=lambda group: float(str(group["period_s"])))


def cycles(timing: PacketArray, control: PacketArray) -> Object:
    """Return how punctual the control cycles were; slots without a control packet are `skipped`."""
    slots = control["cycle"].astype(np.int64)
    return {
        "count": len(control),
        "skipped": int(slots[-1] - slots[0]) + 1 - len(slots) if len(slots) else 0,
        "lateness_s": _percentiles(timing["lateness"].astype(float)),
        "execution_s": _percentiles(timing["execution"].astype(float)),
    }


def _percentiles(values: FloatArray) -> Object | None:
    """Return median, 99th percentile and maximum, None of nothing."""
    if not len(values):
        return None
    p50, p99 = np.percentile(values, [50.0, 99.0])
    return {"p50": float(p50), "p99": float(p99), "max": float(values.max())}


def jobs(packets: PacketArray) -> list[Object]:
    """Return count, outcomes and times of each worker's jobs."""
    names = np.array([to_text(name) for name in packets["name"]], dtype=object)
    found = []
    for name in sorted(set(names)):
        own = packets[names == name]
        outcomes = Counter(to_text(outcome) for outcome in own["outcome"])
        times = _percentiles(own["execution"].astype(float))
        found.append({"name": name, "count": len(own), "outcomes": dict(outcomes), "execution_s": times})
    return found


def planner(packets: PacketArray) -> Object:
    """Return how many plans were made, flown, stretched and refused, and why."""
    accepted = packets["accepted"] == 1
    status = np.array([to_text(value) for value in packets["status"]], dtype=object)
    flown = packets[accepted]
    return {
        "plans": len(packets),
        "accepted": int(accepted.sum()),
        "refused": int((~accepted).sum()),
        "stretched": int(np.sum(status[accepted] == "stretched")),
        "refusals": dict(Counter(status[~accepted])),
        "longest_horizon_s": float(flown["horizon"].max()) if len(flown) else None,
        "peak_current_a": float(flown["peak_current"].max()) if len(flown) else None,
    }


def events(packets: PacketArray) -> list[Object]:
    """Return the events by name in order of first appearance; `count` has those the throttle held back."""
    found: dict[str, Object] = {}
    for row, time in zip(packets, seconds(packets), strict=True):
        event = found.setdefault(
            to_text(row["name"]),
            {
                "count": 0,
                "severity": int(row["severity"]),
                "first_s": float(time),
                "text": to_text(row["text"]),
            },
        )
        event["count"] += 1 + int(row["suppressed"])
    return [{"name": name, **event} for name, event in found.items()]


def modes(packets: PacketArray) -> list[Object]:
    """Return the modes in order, each with when it was entered and what led to it."""
    return [
        {
            "mode": Mode(int(row["mode"])).label,
            "at_s": float(time),
            "trigger": to_text(row["trigger"]),
            "reason": to_text(row["reason"]),
        }
        for row, time in zip(packets, seconds(packets), strict=True)
    ]


def step_ends(packets: PacketArray) -> FloatArray:
    """Return the times, s, at which a mode ended any step: by command, or because nothing is steered."""
    by_command = np.array([to_text(row["trigger"]).startswith("commanded") for row in packets], dtype=bool)
    steering = np.isin(packets["mode"], [int(mode) for mode in STEERING])
    return seconds(packets)[by_command | ~steering]


def health(packets: PacketArray) -> Object | None:
    """Return the share of looks at which each stream was good, what else was seen; None without a look."""
    if not len(packets):
        return None
    streams = {
        name: float(np.mean(packets[name] == StreamState.GOOD))
        for name in ("imu", "field", "coils", "power", "camera")
        if (packets[name] != StreamState.NOT_FITTED).any()
    }
    held = int(np.bitwise_or.reduce(packets["facts"].astype(np.uint64)))
    return {
        "streams_good": streams,
        "facts": [fact.name for bit, fact in enumerate(FACTS) if held >> bit & 1],
        "watchdog_fed": int(packets["fed"][-1]),
        "clock_steps": int(packets["clock_steps"][-1]),
        "cpu_share": _largest(packets["cpu_share"]),
        "proportional_bytes": _largest(packets["proportional"]),
        "memory_slope_bytes_per_hour": _last(packets["memory_slope"], 3600.0),
        "disk_free_bytes": _last(packets["disk_free"]),
        "temperature_c": _largest(packets["temperature"]),
    }


def _largest(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else None


def _last(values: FloatArray, scale: float = 1.0) -> float | None:
    known = values[np.isfinite(values)]
    return float(known[-1]) * scale if len(known) else None


def logs(run: Run) -> list[Object]:
    """Return the integrity of each log that is there."""
    return [
        {
            "log": stem,
            "bytes": log.total_bytes,
            "packets": sum(log.counts.values()),
            "counts": log.counts,
            "skipped_bytes": log.skipped_bytes,
            "truncated_bytes": log.truncated_bytes,
            "missing_packets": sum(log.missing.values()),
            "other_versions": log.other_versions,
            "dropped_segments": run.dropped_segments(stem),
        }
        for stem, log in run.logs.items()
        if log.total_bytes
    ]
