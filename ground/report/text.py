"""The report as text, from the object that `ground.report.summary.summarise` makes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from flight.link.telemetry.definitions import SEVERITIES
from ground.report.performance import SETTLING_BAND, SETTLING_LIMIT_S, STEADY_STATE_S

Object = dict[str, Any]

ARCSECONDS = 648_000.0 / math.pi
_LISTED = 20


def format_report(summary: Object) -> str:
    """Return the whole report, ending in a newline."""
    blocks = [
        _headline(summary),
        _steps(summary),
        _detumbling(summary["detumbling"]),
        _knowledge(summary["knowledge"]),
        _pointing(summary["pointing"]),
        _bounds("Against the requirements of the configuration", "required", summary["requirements"]),
        _bounds("Worst against the thesis (Sease 2013, Table 5.3 and ch. 5)", "bound", summary["thesis"]),
        _power(summary["power"], bool(summary["thesis"])),
        _loop(summary),
        _planner(summary),
        _sensing(summary),
        _objects(summary["objects"]),
        _modes(summary["modes"]),
        _health(summary["health"]),
        _events(summary["events"]),
        _logs(summary["logs"]),
        [f"note: {note}" for note in summary["notes"]],
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block) + "\n"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return aligned lines, two spaces in: the first column to the left, the others to the right."""
    cells = [list(head), *(list(row) for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    return [
        "  "
        + "  ".join(c.rjust(w) if i else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True)))
        for row in cells
    ]


def number(value: float | None, digits: int = 2, scale: float = 1.0) -> str:
    """Return a number with a fixed count of decimals, "-" for None."""
    return "-" if value is None else f"{value * scale:.{digits}f}"


def _signed(q2: float | None) -> str:
    return "-" if q2 is None else f"{q2:+.3f}"


def _headline(summary: Object) -> list[str]:
    run = summary["run"]
    lines = [f"Run {run['folder']}: {number(run['duration_s'], 1)} s"]
    if "software" in run:
        devices = "simulated hardware" if run["simulated"] else "hardware"
        pace = "real time" if run["realtime"] else "lock-step"
        seed = f", seed {run['seed']}" if run["simulated"] else ""
        lines.append(f"{run['config_name']} on {devices}, {pace}{seed}, software {run['software']}")
    return lines


def _steps(summary: Object) -> list[str]:
    if not summary["steps"]:
        return []
    rows = []
    for step in summary["steps"]:
        rise = number(step["rise_s"]) + ("" if step["rise_judged"] or step["rise_s"] is None else " *")
        rows.append(
            [
                f"{step['index']}{' again' if step['again'] else ''}  "
                f"{_signed(step['from_q2'])} -> {_signed(step['target_q2'])}",
                number(step["start_s"], 1),
                number(step["steady_state_deg"]),
                number(step["overshoot_percent"], 1),
                rise,
                number(step["settling_s"]),
            ]
        )
    head = ["step, q2", "at s", "steady state deg", "overshoot %", "rise s", "settling s"]
    lines = [f"Attitude steps, judged on the {summary['attitude_source']}", *table(head, rows)]
    if any(not step["rise_judged"] for step in summary["steps"]):
        lines.append("  * from the release, or from a body on its way: its rise is not judged")
    return [
        *lines,
        "  rise: from 10 to 90 % of the step; overshoot: beyond the target, in % of the step;",
        f"  settling: the last entry into +-{100 * SETTLING_BAND:g} % of the step about the target;",
        f"  steady state: the largest error in the last {STEADY_STATE_S:g} s of a target that stands for "
        f"{2 * STEADY_STATE_S:g} s or more;",
        f"  a step that ended within {SETTLING_LIMIT_S:g} s, not settled, is interrupted and not judged",
    ]


def _detumbling(found: Object | None) -> list[str]:
    if found is None:
        return []
    degrees = 180.0 / math.pi
    rows = [
        [
            number(period["begin_s"], 1),
            number(period["duration_s"], 1),
            *(number(period[f"{name}_rate_rad_s"], 2, degrees) for name in ("first", "largest", "last")),
            "yes" if period["slowed"] else "no",
        ]
        for period in found["periods"]
    ]
    head = ["braked from s", "for s", "first deg/s", "largest deg/s", "last deg/s", "slow in the end"]
    known, error = found["rate_known_share"], found["rate_error_rms_rad_s"]
    return [
        f"Detumbling, rates of the {'truth' if found['rate_source'] == 'truth' else 'gyro'}",
        *table(head, rows),
        f"  rate by the magnetometer alone: known {number(known, 1, 100.0)} % of the time, error "
        f"{number(error, 3, degrees)} deg/s rms an axis, found again {found['restarts']} times",
    ]


def _knowledge(found: Object | None) -> list[str]:
    if found is None:
        return []
    degrees = 180.0 / math.pi
    share = ", ".join(f"{name} {number(part, 1, 100.0)} %" for name, part in found["share"].items())
    dipole = found["dipole_error_share"]
    return [
        "Attitude knowledge",
        f"  {share}; fine first at {number(found['fine_after_s'], 1)} s",
        f"  error while fine {number(found['fine_error_rms_rad'], 4, degrees)} deg rms of three axes "
        f"(with stars {number(found['with_stars_error_rms_rad'], 4, degrees)}), "
        f"at most {number(found['fine_error_worst_rad'], 4, degrees)}; "
        f"{number(found['worst_sigmas'], 1)} sigma of an axis at most, "
        f"NEES of an axis {number(found['nees_per_axis'], 2)}",
        f"  residual dipole known to {number(dipole['sunlight'], 0, 100.0)} % in the last ten minutes of "
        f"sunlight, {number(dipole['shadow'], 0, 100.0)} % in those of shadow",
        f"  refused {found['refused']} measurements and {found['fixes_refused']} fixes, "
        f"{found['restarts']} new starts",
    ]


def _pointing(found: Object | None) -> list[str]:
    if found is None:
        return []
    degrees = 180.0 / math.pi
    errors = ("axis_rms_rad", "axis_worst_rad", "all_axes_rms_rad")
    rows = [
        [
            aim["target"],
            number(aim["begin_s"], 1),
            number(aim["duration_s"], 1),
            *(number(aim[name], 2, degrees) for name in errors),
            number(aim["supply_w"], 2, 1e3),
            number(aim["heat_w"], 2, 1e3),
        ]
        for aim in found["targets"]
    ]
    head = [
        "pointing to",
        "from s",
        "for s",
        "axis deg rms",
        "at most",
        "all axes deg rms",
        "V |I| mW",
        "R I^2 mW",
    ]
    return [
        f"Pointing, {'true' if found['source'] == 'truth' else 'estimated'} attitude",
        *table(head, rows),
        f"  errors from {number(found['settled_after_s'], 0)} s after the begin on, or the first slew's end",
    ]


def _objects(found: list[Object]) -> list[str]:
    if not found:
        return []
    degrees = 180.0 / math.pi
    rows = [
        [
            str(row["number"]),
            number(row["first_s"], 1),
            number(row["last_s"], 1),
            f"{row['seen']} of {row['frames']}",
            number(row["rate_least_rad_s"], 3, degrees),
            number(row["rate_most_rad_s"], 3, degrees),
            number(row["magnitude"], 1),
            number(row["sighting_sigma_rad"], 2, ARCSECONDS),
        ]
        for row in found
    ]
    head = ["object", "from s", "to s", "seen in", "deg/s least", "most", "V", "sigma of a sighting, arcsec"]
    return ["Objects among the stars", *table(head, rows)]


def _bounds(title: str, bound: str, judged: list[Object]) -> list[str]:
    if not judged:
        return []
    rows = [
        [
            row["quantity"],
            number(row["worst"], 2 if row["limit"] >= 1.0 else 4),
            f"{row['limit']:g} {row['unit']}",
            row["verdict"],
        ]
        for row in judged
    ]
    return [title, *table(["", "here", bound, ""], rows)]


def _power(power: Object, compared: bool) -> list[str]:
    """Return the lines of the power, `compared` with the thesis's."""
    if power["source"] is None:
        return []
    currents = (
        (power["peak_current_a"], "written"),
        (power["peak_current_actual_a"], "in the coils (truth)"),
    )
    largest = [f"{number(value, 4)} A {where}" for value, where in currents if value is not None]
    thesis = "on average on the order of 100 mW, at most about 0.5 W"
    rows = [
        (
            "supply power V |I| at the coils",
            f"on average {number(power['supply_average_w'], 1, 1e3)} mW, "
            f"at most {number(power['supply_peak_w'], 3)} W, {number(power['supply_j'], 2)} J in all",
        ),
        ("supply power measured at the bus", f"on average {number(power['bus_average_w'], 1, 1e3)} mW"),
        *([("consumption stated in the thesis", thesis)] if compared else []),
        (
            "R I^2, heat of steady currents",
            f"on average {number(power['heat_average_w'], 3, 1e3)} mW, {number(power['heat_j'], 3)} J in all",
        ),
        ("largest current", ", ".join(largest)),
    ]
    return [
        f"Coil power, from the currents {'in the coils' if power['source'] == 'truth' else 'written'}",
        *(f"  {name:34}{text}" for name, text in rows),
    ]


def _loop(summary: Object) -> list[str]:
    lines = []
    if summary["rate_groups"]:
        rows = [
            [
                group["name"],
                number(group["period_s"], 3),
                str(group["cycles"]),
                str(group["slips"]),
                str(group["overruns"]),
                number(group["mean_s"], 3, 1e3),
                number(group["max_s"], 3, 1e3),
            ]
            for group in summary["rate_groups"]
        ]
        head = ["rate group", "period s", "cycles", "slips", "overruns", "mean ms", "max ms"]
        lines += ["Rate groups", *table(head, rows)]
    timed = {
        "lateness of a control cycle": summary["cycles"]["lateness_s"],
        "execution of a control cycle": summary["cycles"]["execution_s"],
        **{
            f"{job['name']}: {job['count']} jobs ({_tally(job['outcomes'])})": job["execution_s"]
            for job in summary["jobs"]
        },
    }
    rows = [
        [name, *(number(times[key], 3, 1e3) for key in ("p50", "p99", "max"))]
        for name, times in timed.items()
        if times is not None
    ]
    if rows:
        lines += ["Times", *table(["", "median ms", "99 % ms", "max ms"], rows)]
    cycles = summary["cycles"]
    return [*lines, f"Control cycles in the log: {cycles['count']}, slots without one: {cycles['skipped']}"]


def _planner(summary: Object) -> list[str]:
    plans = summary["planner"]
    if not plans["plans"]:
        return []
    refusals = f" ({_tally(plans['refusals'])})" if plans["refusals"] else ""
    return [
        "Planner",
        f"  plans {plans['plans']}, flown {plans['accepted']} of which stretched {plans['stretched']}, "
        f"refused {plans['refused']}{refusals}",
        f"  longest horizon {number(plans['longest_horizon_s'], 1)} s, "
        f"largest planned current {number(plans['peak_current_a'], 4)} A",
    ]


def _sensing(summary: Object) -> list[str]:
    lines = []
    estimate = summary["estimate"]
    if estimate is not None:
        lines.append(
            f"Estimate: rms error {number(estimate['angle_rms_rad'], 3, 1e3)} mrad, "
            f"{number(estimate['rate_rms_rad_s'], 3, 1e3)} mrad/s; "
            f"over its own sigma {number(estimate['angle_normalised'])}, "
            f"{number(estimate['rate_normalised'])}"
        )
    streaks = summary["streaks"]
    if streaks["frames"]:
        lines.append(
            f"Streaks: {streaks['frames']} frames ({_tally(streaks['status'])}), "
            f"{streaks['rates']} rates, {streaks['accepted']} into the estimate"
        )
    if streaks["rms_error"] is not None:
        errors = ", ".join(number(error, 3, 1e3) for error in streaks["rms_error"])
        lines.append(
            f"  rms error x, y, z {errors} mrad/s of {streaks['compared']} rates; "
            f"mean e' P^-1 e / 3 = {number(streaks['normalised'])}"
        )
    return lines + _stars(summary["stars"]) + _failed_frames(summary["failed_frames"])


def _failed_frames(frames: list[Object]) -> list[str]:
    if not frames:
        return []
    rows = [
        [str(frame["sequence"]), number(frame["exposed_s"], 3), frame["streaks"], frame["stars"] or "-"]
        for frame in frames[:_LISTED]
    ]
    more = [f"  and {len(frames) - _LISTED} more: --json lists all"] if len(frames) > _LISTED else []
    head = ["frame", "exposed at s", "streaks", "stars"]
    return [f"Frames without rate or attitude: {len(frames)}", *table(head, rows), *more]


def _stars(stars: Object) -> list[str]:
    if not stars["frames"]:
        return []
    lines = [
        f"Stars:   {stars['frames']} frames ({_tally(stars['status'])}), {stars['tracked']} tracked, "
        f"{number(stars['matched'], 0)} stars matched in the median, {stars['accepted']} into the estimate"
    ]
    if stars["rms_error"] is not None:
        errors = ", ".join(number(error, 2, ARCSECONDS) for error in stars["rms_error"])
        lines.append(
            f"  rms error about x, y, z {errors} arcsec of {stars['compared']} attitudes; "
            f"mean e' P^-1 e / 3 = {number(stars['normalised'])}"
        )
    return lines


def _modes(modes: list[Object]) -> list[str]:
    if not modes:
        return []
    rows = [[mode["mode"], number(mode["at_s"], 3), mode["trigger"], mode["reason"] or "-"] for mode in modes]
    return ["Modes", *table(["", "at s", "by", "because"], rows)]


def _health(health: Object | None) -> list[str]:
    if health is None:
        return []
    good = ", ".join(f"{name} {number(share, 1, 1e2)} %" for name, share in health["streams_good"].items())
    lines = [
        f"Health: streams good {good}",
        f"  facts that counted: {', '.join(health['facts']) or 'none'}; "
        f"watchdog fed {health['watchdog_fed']} times, wall clock set {health['clock_steps']} times",
    ]
    if health["proportional_bytes"] is not None:
        lines.append(
            f"  at most {number(health['cpu_share'])} of a core, "
            f"{number(health['proportional_bytes'], 0, 2.0**-20)} MiB, "
            f"{number(health['temperature_c'], 1)} deg C; memory slope "
            f"{number(health['memory_slope_bytes_per_hour'], 2, 2.0**-20)} MiB/h; "
            f"{number(health['disk_free_bytes'], 0, 2.0**-20)} MiB of disk free"
        )
    return lines


def _events(events: list[Object]) -> list[str]:
    if not events:
        return []
    rows = [
        [event["name"], _severity(event["severity"]), str(event["count"]), number(event["first_s"], 3)]
        for event in events
    ]
    return ["Events", *table(["", "severity", "count", "first at s"], rows)]


def _severity(code: int) -> str:
    return dict(SEVERITIES).get(code, str(code))


def _logs(logs: list[Object]) -> list[str]:
    keys = ["packets", "bytes", "skipped_bytes", "truncated_bytes", "missing_packets", "other_versions"]
    keys.append("dropped_segments")
    head = ["log", "packets", "bytes", "skipped", "cut off", "missing", "other version", "dropped segments"]
    return ["Log integrity", *table(head, [[log["log"], *(str(log[key]) for key in keys)] for log in logs])]


def _tally(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
