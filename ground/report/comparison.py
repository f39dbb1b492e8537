"""Two runs side by side: what was flown otherwise, and every figure of both with the difference."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flight.schema.document import read_document, read_text
from ground.report.text import ARCSECONDS, number, table
from knightcube.errors import UsageError

Object = dict[str, Any]
_MISSING = object()


def compare(first: Object, second: Object) -> Object:
    """Return the comparison of two summaries (`ground.report.summarise`), ready for JSON.

    A difference is of the second less the first; None where either is unknown or does not apply.
    """
    pair = dict(_figures(first)), dict(_figures(second))
    return {
        "runs": [first["run"], second["run"]],
        "configuration": _configuration(*(Path(one["run"]["folder"]) for one in (first, second))),
        "figures": [_row(name, pair[0].get(name), pair[1].get(name)) for name in _merged(*pair)],
        "events": _events(first, second),
        "notes": [first["notes"], second["notes"]],
    }


def format_comparison(compared: Object) -> str:
    """Return the comparison as text, ending in a newline."""
    lines = [f"{letter}  {_flown(run)}" for letter, run in zip("AB", compared["runs"], strict=True)]
    changed = compared["configuration"]
    if changed is None:
        lines += ["", "Configurations not compared: a folder has none that can be read"]
    elif changed:
        rows = [[item["key"], _short(item["a"]), _short(item["b"])] for item in changed]
        lines += ["", "Configured otherwise", *table(["", "A", "B"], rows)]
    else:
        lines += ["", "Configured alike"]
    rows = [
        [row["figure"], row["unit"], *(_value(row[key]) for key in ("a", "b")), _difference(row)]
        for row in compared["figures"]
    ]
    lines += ["", "Figures", *table(["", "", "A", "B", "B - A"], rows)]
    events = [[item["name"], str(item["a"]), str(item["b"])] for item in compared["events"]]
    lines += ["", "Events", *table(["", "A", "B"], events)] if events else []
    for letter, notes in zip("AB", compared["notes"], strict=True):
        lines += [f"note: {letter}: {note}" for note in notes]
    return "\n".join(lines) + "\n"


def _figures(summary: Object) -> Iterator[tuple[str, tuple[float | None, str]]]:
    """Yield name, value and unit of each figure of a summary, in the report's order."""
    yield "duration", (summary["run"]["duration_s"], "s")
    for row in summary["thesis"]:
        yield f"worst {row['quantity']}", (row["worst"], row["unit"])
    times: dict[int, int] = {}
    for step in summary["steps"]:
        again = times[step["index"]] = times.get(step["index"], 0) + 1
        name = f"step {step['index']}" + (f" ({again})" if again > 1 else "")
        yield f"{name}: steady state", (step["steady_state_deg"], "deg")
        yield f"{name}: overshoot", (step["overshoot_percent"], "%")
        yield f"{name}: rise", (step["rise_s"], "s")
        yield f"{name}: settling", (step["settling_s"], "s")
    power = summary["power"]
    yield "supply at the coils, V |I|, average", (_scaled(power["supply_average_w"], 1e3), "mW")
    yield "supply at the bus, average", (_scaled(power["bus_average_w"], 1e3), "mW")
    yield "R I^2, heat of steady currents, average", (_scaled(power["heat_average_w"], 1e3), "mW")
    yield "R I^2, heat of steady currents, energy", (power["heat_j"], "J")
    yield from _sensing(summary)
    yield from _loop(summary)


def _sensing(summary: Object) -> Iterator[tuple[str, tuple[float | None, str]]]:
    estimate = summary["estimate"] or {}
    yield "estimate: angle, rms error", (_scaled(estimate.get("angle_rms_rad"), 1e3), "mrad")
    yield "estimate: rate, rms error", (_scaled(estimate.get("rate_rms_rad_s"), 1e3), "mrad/s")
    yield "estimate: angle over its sigma", (estimate.get("angle_normalised"), "")
    yield "estimate: rate over its sigma", (estimate.get("rate_normalised"), "")
    for kind, found, unit, scale in (
        ("streaks", "rates", "mrad/s", 1e3),
        ("stars", "solved", "arcsec", ARCSECONDS),
    ):
        part = summary[kind]
        yield f"{kind}: frames", (part["frames"], "")
        yield f"{kind}: {found}", (part[found], "")
        yield f"{kind}: into the estimate", (part["accepted"], "")
        errors = part["rms_error"]
        worst = None if errors is None else max(errors) * scale
        yield f"{kind}: worst axis, rms error", (worst, unit)
        yield f"{kind}: mean e' P^-1 e / 3", (part["normalised"], "")
    yield "frames without rate or attitude", (len(summary["failed_frames"]), "")


def _loop(summary: Object) -> Iterator[tuple[str, tuple[float | None, str]]]:
    for name in ("plans", "accepted", "stretched", "refused"):
        yield f"planner: {name}", (summary["planner"][name], "")
    timed = {f"cycle {name}": summary["cycles"][f"{name}_s"] for name in ("lateness", "execution")}
    timed |= {f"{job['name']} job": job["execution_s"] for job in summary["jobs"]}
    for name, times in timed.items():
        for key, label in (("p50", "median"), ("p99", "99 %"), ("max", "max")):
            yield f"{name}, {label}", (_scaled((times or {}).get(key), 1e3), "ms")
    yield "control slots skipped", (summary["cycles"]["skipped"], "")
    for log in summary["logs"]:
        lost = log["missing_packets"] + log["skipped_bytes"] + log["truncated_bytes"]
        yield f"log {log['log']}: missing packets and bad bytes", (lost, "")


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else value * scale


def _merged(first: Object, second: Object) -> list[str]:
    """Return the names of both in order, those that only the second has last; unknown in both left out."""
    names = [*first, *(name for name in second if name not in first)]
    nothing = (None, "")
    return [name for name in names if any(one.get(name, nothing)[0] is not None for one in (first, second))]


def _row(name: str, first: tuple[Any, str] | None, second: tuple[Any, str] | None) -> Object:
    (a, unit), (b, other) = first or (None, ""), second or (None, "")
    difference = None if a is None or b is None else b - a
    return {"figure": name, "unit": unit or other, "a": a, "b": b, "difference": difference}


def _events(first: Object, second: Object) -> list[Object]:
    counts = [{event["name"]: event["count"] for event in one["events"]} for one in (first, second)]
    return [
        {"name": name, "a": counts[0].get(name, 0), "b": counts[1].get(name, 0)}
        for name in dict.fromkeys([*counts[0], *counts[1]])
    ]


def _configuration(first: Path, second: Path) -> list[Object] | None:
    """Return the keys whose values differ; None where a configuration cannot be read."""
    try:
        pair = [dict(_flat("", _values(folder / "config.yaml"))) for folder in (first, second)]
    except UsageError:
        return None
    return [
        {"key": key, "a": pair[0].get(key), "b": pair[1].get(key)}
        for key in dict.fromkeys([*pair[0], *pair[1]])
        if pair[0].get(key, _MISSING) != pair[1].get(key, _MISSING)
    ]


def _values(path: Path) -> Object:
    values: Object = read_document(read_text(path), str(path)).values
    return values


def _flat(prefix: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict) and value:
        for key, below in value.items():
            yield from _flat(f"{prefix}.{key}" if prefix else str(key), below)
    else:
        yield prefix, value


def _flown(run: Object) -> str:
    text = f"{run['folder']}: {number(run['duration_s'], 1)} s"
    if "software" not in run:
        return text
    pace = "real time" if run["realtime"] else "lock-step"
    seed = f", seed {run['seed']}" if run["simulated"] else ", real devices"
    return f"{text} of {run['config_name']}, {pace}{seed}, software {run['software']}"


def _short(value: Any) -> str:
    text = "-" if value is None else str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _value(value: float | None) -> str:
    return "-" if value is None else str(value) if isinstance(value, int) else f"{value:.4g}"


def _difference(row: Object) -> str:
    difference = row["difference"]
    if difference is None or difference == 0:
        return "" if difference is None else "0"
    text = f"{difference:+d}" if isinstance(difference, int) else f"{difference:+.3g}"
    return text if row["a"] == 0 else f"{text} ({100.0 * difference / abs(row['a']):+.0f} %)"
