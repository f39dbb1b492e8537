"""The summary of a flight, as text and for `--json`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flight.app.cli import PROGRAM
from flight.app.request import RunResult
from flight.loop.ending import Ending


def summary_text(result: RunResult, elapsed: float) -> str:
    """Return how a flight went, in lines; `elapsed` s on the machine's clock."""
    ending = result.ending
    lines = [
        ("flown", f"{ending.mission_time:.0f} s in {elapsed:.1f} s, {result.reason}"),
        ("mode", ending.mode),
        ("alarms", ", ".join(ending.alarms) or "none"),
        ("noticed", counts_text(ending.faults, "faults") + "; " + counts_text(ending.warnings, "warnings")),
        ("coils", _coils(ending)),
    ]
    if result.faults:
        lines.append(("injected", "; ".join(result.faults)))
    lines += [("log", str(result.folder)), ("next", f"{PROGRAM} report {result.folder}")]
    return "".join(f"{name + ':':10}{text}\n" for name, text in lines)


def summary_facts(result: RunResult, elapsed: float) -> dict[str, Any]:
    """Return how a flight went, for `--json`."""
    ending = result.ending
    return {
        "folder": str(result.folder),
        "reason": result.reason,
        "interrupted": result.interrupted,
        "mission_time_s": ending.mission_time,
        "elapsed_s": elapsed,
        "packets": ending.cycles,
        "mode": ending.mode,
        "alarms": ending.alarms,
        "noticed_faults": dict(ending.faults),
        "noticed_warnings": dict(ending.warnings),
        "coils_at_zero": ending.coils_at_zero,
        "coils_left_out": ending.coils_left_out,
        "log_error": result.log_error or None,
        "faults": result.faults,
    }


def counts_text(counts: Mapping[str, int], noun: str) -> str:
    """Return how often each event of a kind came, in a phrase."""
    if not counts:
        return f"no {noun}"
    return f"{noun} " + ", ".join(f"{name} ({count})" for name, count in sorted(counts.items()))


def _coils(ending: Ending) -> str:
    state = "at zero" if ending.coils_at_zero else f"NOT confirmed at zero: {ending.coil_error}"
    left_out = ", ".join(ending.coils_left_out)
    return f"{state}; left out: {left_out}" if left_out else state
