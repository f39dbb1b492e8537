"""Reports over several runs: two runs side by side, and an archive of runs as a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from flight.link import events
from flight.link.telemetry.log import find_runs, find_segments
from flight.schema.document import read_document, read_text
from ground.report.signals import last_time
from ground.report.text import ARCSECONDS, DEGREES, number, provenance, table
from ground.telemetry import Run, read_run, text_of
from knightcube.errors import UsageError

Object = dict[str, Any]
_MISSING = object()


def compare(first: Object, second: Object) -> Object:
    """Return the comparison of two summaries (`ground.report.summarise`) as JSON data.

    Differences are the second value minus the first, or None if either is unknown or not applicable.
    """
    a, b = dict(_figures(first)), dict(_figures(second))
    figures = []
    for name in dict.fromkeys([*a, *b]):
        (before, unit), (after, other) = a.get(name, (None, "")), b.get(name, (None, ""))
        if before is not None or after is not None:
            difference = None if before is None or after is None else after - before
            values = {"unit": unit or other, "a": before, "b": after, "difference": difference}
            figures.append({"figure": name, **values})
    counts = [{event["name"]: event["count"] for event in one["events"]} for one in (first, second)]
    return {
        "runs": [first["run"], second["run"]],
        "configuration": _configuration(*(Path(one["run"]["folder"]) for one in (first, second))),
        "figures": figures,
        "events": [
            {"name": name, "a": counts[0].get(name, 0), "b": counts[1].get(name, 0)}
            for name in dict.fromkeys([*counts[0], *counts[1]])
        ],
        "notes": [first["notes"], second["notes"]],
    }


def _configuration(first: Path, second: Path) -> list[Object] | None:
    """Return the keys whose values differ, or None if a configuration cannot be read."""
    try:
        paths = (folder / "config.yaml" for folder in (first, second))
        a, b = (dict(_flat("", read_document(read_text(path), str(path)).values)) for path in paths)
    except UsageError:
        return None
    return [
        {"key": key, "a": a.get(key), "b": b.get(key)}
        for key in dict.fromkeys([*a, *b])
        if a.get(key, _MISSING) != b.get(key, _MISSING)
    ]


def _flat(prefix: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested sections with dotted keys."""
    if isinstance(value, dict) and value:
        for key, below in value.items():
            yield from _flat(f"{prefix}.{key}" if prefix else str(key), below)
    else:
        yield prefix, value


_Figure = tuple[str, tuple[float | None, str]]
"""Name, value and unit of a performance measure."""


def _figures(summary: Object) -> Iterator[_Figure]:
    """Yield name, value and unit of each performance measure in a summary, in the order of the report."""
    yield "duration", (summary["run"]["duration_s"], "s")
    for row in [*summary["thesis"], *summary["requirements"]]:
        yield f"worst {row['quantity']}", (row["worst"], row["unit"])
    steps = summary["steps"]
    for step, name in zip(steps, _counted(f"step {step['index']}" for step in steps), strict=True):
        yield f"{name}: steady state", (step["steady_state_deg"], "deg")
        yield f"{name}: overshoot", (step["overshoot_percent"], "%")
        yield f"{name}: rise", (step["rise_s"], "s")
        yield f"{name}: settling", (step["settling_s"], "s")
    yield from _detumbling(summary["detumbling"])
    yield from _knowledge(summary["knowledge"])
    yield from _pointing(summary["pointing"])
    yield from _power(summary["power"])
    yield from _battery(summary.get("battery"))
    yield from _sensing(summary)
    yield from _objects(summary)
    yield from _loop(summary)


def _power(power: Object) -> Iterator[_Figure]:
    yield "largest commanded current", (power["peak_current_a"], "A")
    yield "supply at the coils, V |I|, average", (_scaled(power["supply_average_w"], 1e3), "mW")
    yield "supply at the bus, average", (_scaled(power["bus_average_w"], 1e3), "mW")
    yield "heat R I^2 of steady currents, average", (_scaled(power["heat_average_w"], 1e3), "mW")
    yield "heat R I^2 of steady currents, energy", (power["heat_j"], "J")


def _sensing(summary: Object) -> Iterator[_Figure]:
    estimate = summary["estimate"] or {}
    yield "estimate: angle, rms error", (_scaled(estimate.get("angle_rms_rad"), 1e3), "mrad")
    yield "estimate: rate, rms error", (_scaled(estimate.get("rate_rms_rad_s"), 1e3), "mrad/s")
    yield "estimate: angle error / sigma", (estimate.get("angle_normalised"), "")
    yield "estimate: rate error / sigma", (estimate.get("rate_normalised"), "")
    for kind, found, unit, scale in (
        ("streaks", "rates", "mrad/s", 1e3),
        ("stars", "solved", "arcsec", ARCSECONDS),
    ):
        part = summary[kind]
        yield f"{kind}: frames", (part["frames"], "")
        yield f"{kind}: {found}", (part[found], "")
        yield f"{kind}: used by the estimator", (part["accepted"], "")
        errors = part["rms_error"] or []
        worst = None if None in errors else max(errors, default=None)
        yield f"{kind}: worst axis, rms error", (_scaled(worst, scale), unit)
        yield f"{kind}: NEES per axis", (part["normalised"], "")
    yield "frames without rate or attitude", (len(summary["failed_frames"]), "")


def _loop(summary: Object) -> Iterator[_Figure]:
    for name in ("plans", "accepted", "stretched", "refused"):
        yield f"planner: {name}", (summary["planner"][name], "")
    timed = {f"cycle {name}": summary["cycles"][f"{name}_s"] for name in ("lateness", "execution")}
    timed |= {f"{job['name']} job": job["execution_s"] for job in summary["jobs"]}
    for name, durations in timed.items():
        for key, label in (("p50", "median"), ("p99", "99 %"), ("max", "max")):
            yield f"{name}, {label}", (_scaled((durations or {}).get(key), 1e3), "ms")
    cycles = summary["cycles"]
    yield "control slots skipped by the loop", (cycles["skipped"] if cycles["count"] else None, "")
    for group in summary["rate_groups"]:
        yield f"rate group {group['name']}: slips", (group["slips"], "")
        yield f"rate group {group['name']}: overruns", (group["overruns"], "")
    for log in summary["logs"]:
        lost = log["missing_packets"] + log["skipped_bytes"] + log["truncated_bytes"]
        yield f"log {log['log']}: missing packets and damaged bytes", (lost, "")


def _counted(names: Iterable[str]) -> Iterator[str]:
    """Yield the names; the second and later uses of a name have a number in brackets."""
    uses: Counter[str] = Counter()
    for name in names:
        uses[name] += 1
        yield name + (f" ({uses[name]})" if uses[name] > 1 else "")


def _detumbling(found: Object | None) -> Iterator[_Figure]:
    if found is None:
        return
    periods = found["periods"]
    for period, name in zip(periods, _counted(["detumbling"] * len(periods)), strict=True):
        yield f"{name}: duration", (period["duration_s"], "s")
        yield f"{name}: maximum rate", (_scaled(period["largest_rate_rad_s"], DEGREES), "deg/s")
        yield f"{name}: last rate", (_scaled(period["last_rate_rad_s"], DEGREES), "deg/s")
    yield "rate from the magnetometer: available", (_scaled(found["rate_known_share"], 100.0), "%")
    error = _scaled(found["rate_error_rms_rad_s"], DEGREES)
    yield "rate from the magnetometer: rms error per axis", (error, "deg/s")
    yield "rate from the magnetometer: restarts", (found["restarts"], "")


def _knowledge(found: Object | None) -> Iterator[_Figure]:
    if found is None:
        return
    for level, share in found["share"].items():
        yield f"attitude knowledge: {level}", (_scaled(share, 100.0), "%")
    yield "attitude knowledge: first fine at", (found["fine_after_s"], "s")
    for key, name in (
        ("fine_error_rms_rad", "rms error"),
        ("with_stars_error_rms_rad", "rms error with stars"),
        ("fine_error_worst_rad", "maximum error"),
    ):
        yield f"fine attitude: {name}", (_scaled(found[key], DEGREES), "deg")
    yield "fine attitude: maximum error / sigma per axis", (found["worst_sigmas"], "")
    yield "fine attitude: NEES per axis", (found["nees_per_axis"], "")
    camera = found["star_camera"] or {}
    error = _scaled(camera.get("with_stars_error_rms_rad"), DEGREES)
    yield "star camera's attitude: rms error with stars", (error, "deg")
    yield "star camera's attitude: NEES per axis", (camera.get("nees_per_axis"), "")
    for one in found["description"]:
        unit = "rad" if one["name"] == "camera" else ""
        yield f"estimated {one['name']}: error at the end", (one["error"], unit)
    for where, share in found["dipole_error_share"].items():
        yield f"residual dipole: error in {where}", (_scaled(share, 100.0), "%")
    yield "measurements refused by the filter", (found["refused"], "")
    yield "GPS fixes refused by the filter", (found["fixes_refused"], "")
    yield "restarts of the filter", (found["restarts"], "")


def _pointing(found: Object | None) -> Iterator[_Figure]:
    targets = found["targets"] if found else []
    for target, name in zip(targets, _counted(f"target {one['target']}" for one in targets), strict=True):
        yield f"{name}: duration", (target["duration_s"], "s")
        yield f"{name}: axis error, rms", (_scaled(target["axis_rms_rad"], DEGREES), "deg")
        yield f"{name}: axis error, maximum", (_scaled(target["axis_worst_rad"], DEGREES), "deg")
        yield f"{name}: error in all axes, rms", (_scaled(target["all_axes_rms_rad"], DEGREES), "deg")
        yield f"{name}: supply at the coils, average", (_scaled(target["supply_w"], 1e3), "mW")
        yield f"{name}: heat R I^2, average", (_scaled(target["heat_w"], 1e3), "mW")


def _battery(found: Object | None) -> Iterator[_Figure]:
    if found is None:
        return
    for key, name in (("charge_lowest", "lowest"), ("charge_last", "at the end")):
        yield f"state of charge, {name}", (_scaled(found[key], 100.0), "%")
    yield "energy into the battery", (found["in_j"], "J")
    yield "energy out of the battery", (found["out_j"], "J")


def _objects(summary: Object) -> Iterator[_Figure]:
    camera = summary["star_camera"] or {}
    yield "unobstructed exposures with attitude or rate", (_scaled(camera.get("share"), 100.0), "%")
    yield "longest gap without attitude or rate", (camera.get("longest_gap_s"), "s")
    yield "objects among the stars", (len(summary["objects"]) or None, "")
    for found in summary["objects"]:
        yield f"object {found['number']}: detections", (found["seen"], "")
        yield f"object {found['number']}: magnitude V", (found["magnitude"], "mag")
        sigma = _scaled(found["sighting_sigma_rad"], ARCSECONDS)
        yield f"object {found['number']}: sigma of a sighting", (sigma, "arcsec")


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else value * scale


def format_comparison(compared: Object) -> str:
    """Return the comparison as text that ends in a newline."""
    lines = []
    for letter, run in zip("AB", compared["runs"], strict=True):
        origin = provenance(run)
        duration = f"{number(run['duration_s'], 1)} s" + (f" of {origin}" if origin else "")
        lines.append(f"{letter}  {run['folder']}: {duration}")
    changed = compared["configuration"]
    if changed is None:
        lines += ["", "Configurations not compared: a folder has no config.yaml that can be read"]
    elif changed:
        rows = [[item["key"], _short(item["a"]), _short(item["b"])] for item in changed]
        lines += ["", "Differences of the configuration", *table(["", "A", "B"], rows)]
    else:
        lines += ["", "The configurations are the same"]
    rows = [
        [row["figure"], row["unit"], *(_value(row[key]) for key in ("a", "b")), _difference(row)]
        for row in compared["figures"]
    ]
    lines += ["", "Figures", *table(["", "", "A", "B", "B - A"], rows)]
    counts = [[item["name"], str(item["a"]), str(item["b"])] for item in compared["events"]]
    lines += ["", "Events", *table(["", "A", "B"], counts)] if counts else []
    for letter, notes in zip("AB", compared["notes"], strict=True):
        lines += [f"note: {letter}: {note}" for note in notes]
    return "\n".join(lines) + "\n"


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


def summarise_archive(archive: Path) -> Object:
    """Return configuration, duration, integrity and end of each run of an archive as JSON data.

    Only one run at a time is in memory.
    """
    return {"archive": str(archive), "runs": [_archived(folder) for folder in find_runs(archive)]}


def _archived(folder: Path) -> Object:
    row: Object = {"folder": str(folder), "config_name": None, "utc": None, "duration_s": None}
    row |= {"packets": 0, "bad_bytes": 0, "missing_packets": 0}
    try:
        run = read_run(folder)
    except UsageError as error:
        logged = find_segments(folder, "flight")
        return {**row, "end": str(error).removeprefix(f"{folder}: ") if logged else "no flight log"}
    log = run.flight
    if len(run["run"]):
        first = run["run"][0]
        row |= {"config_name": text_of(first["config_name"]), "utc": _label(int(run["run"]["utc_ns"][-1]))}
    row |= {
        "duration_s": last_time(run),
        "packets": sum(log.counts.values()),
        "bad_bytes": log.skipped_bytes + log.truncated_bytes,
    }
    return row | {"missing_packets": sum(log.missing.values()), "end": _end(run)}


def _end(run: Run) -> str:
    recorded = run["event"]
    stops = recorded["text"][recorded["code"] == events.STOPPED.code]
    return text_of(stops[-1]) if len(stops) else "unclean: the log has no stop event"


def _label(utc_ns: int) -> str | None:
    try:
        return f"{datetime.fromtimestamp(utc_ns * 1e-9, UTC):%Y-%m-%d %H:%M:%S}"
    except (ValueError, OverflowError, OSError):
        return None


def format_archive(summary: Object) -> str:
    """Return the table of an archive as text that ends in a newline."""
    head = ["run", "configuration", "UTC (label)", "s", "packets", "damaged bytes", "missing", "end"]
    rows = [
        [
            Path(row["folder"]).name,
            row["config_name"] or "-",
            row["utc"] or "-",
            number(row["duration_s"], 1),
            str(row["packets"]),
            str(row["bad_bytes"]),
            str(row["missing_packets"]),
            row["end"],
        ]
        for row in summary["runs"]
    ]
    lines = [f"Archive {summary['archive']}: {len(rows)} runs", *table(head, rows)]
    return "\n".join(lines) + "\n"
