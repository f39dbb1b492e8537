"""Text form of the report, made from the object that `ground.report.summary.summarise` returns."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

from flight.link.telemetry.definitions import SEVERITIES
from ground.report.steps import SETTLING_BAND, SETTLING_LIMIT_S, STEADY_STATE_S
from ground.telemetry import date_of

Object = dict[str, Any]
Column = tuple[str, int, float] | Callable[[Object], str]
"""Column of a table: key, decimals and scale of a number in a row, or a function that formats a row."""

ARCSECONDS = 648_000.0 / math.pi
DEGREES = 180.0 / math.pi
_THESIS = "Worst values and limits of the thesis (Sease 2013, Table 5.3 and ch. 5)"
_MAX_LISTED = 20  # maximum number of lines in the table of failed frames


def format_report(summary: Object) -> str:
    """Return the whole report, ending in a newline."""
    run, origin = summary["run"], provenance(summary["run"])
    utc_ns = run.get("utc_ns", 0)
    start = f"mission time 0 s is {date_of(utc_ns)}" if utc_ns > 0 else ""
    blocks = [
        [f"Run {run['folder']}: {number(run['duration_s'], 1)} s", *filter(None, (origin, start))],
        _steps(summary),
        _detumbling(summary["detumbling"]),
        _knowledge(summary["knowledge"]),
        _pointing(summary["pointing"]),
        _limits("Requirements of the configuration", "required", summary["requirements"]),
        _limits(_THESIS, "limit", summary["thesis"]),
        _power(summary["power"], bool(summary["thesis"])),
        _battery(summary.get("battery")),
        _loop(summary),
        _planner(summary["planner"]),
        _sensing(summary),
        _objects(summary["objects"]),
        _modes(summary["modes"]),
        _health(summary["health"]),
        _events(summary["events"]),
        _coils(summary["coils"]),
        _logs(summary["logs"]),
        [f"note: {note}" for note in summary["notes"]],
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block) + "\n"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return aligned lines, indented by two spaces.

    The first column is left-aligned, and the other columns are right-aligned.
    """
    cells = [list(head), *(list(row) for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    return [
        "  "
        + "  ".join(c.rjust(w) if i else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True)))
        for row in cells
    ]


def columns(rows: Sequence[Object], shown: Mapping[str, Column]) -> list[str]:
    """Return rows as aligned lines with a column for each heading in `shown`."""
    cells = [
        [one(row) if callable(one) else number(row[one[0]], *one[1:]) for one in shown.values()]
        for row in rows
    ]
    return table(list(shown), cells)


def number(value: float | None, digits: int = 2, scale: float = 1.0) -> str:
    """Return a number with a fixed count of decimals, or "-" for None."""
    return "-" if value is None else f"{value * scale:.{digits}f}"


def provenance(run: Object) -> str:
    """Return a line on the origin of a run: configuration, devices and software; empty if unknown."""
    if "software" not in run:
        return ""
    devices = f"simulated devices, seed {run['seed']}" if run["simulated"] else "real devices"
    pace = "real time" if run["realtime"] else "lock-step"
    return f"{run['config_name']} on {devices}, {pace}, software {run['software']}"


def _steps(summary: Object) -> list[str]:
    def named(step: Object) -> str:
        start, target = ("-" if q2 is None else f"{q2:+.3f}" for q2 in (step["from_q2"], step["target_q2"]))
        return f"{step['index']}{' again' if step['again'] else ''}  {start} -> {target}"

    def rise(step: Object) -> str:
        return number(step["rise_s"]) + ("" if step["rise_judged"] or step["rise_s"] is None else " *")

    if not summary["steps"]:
        return []
    shown: dict[str, Column] = {
        "step, q2": named,
        "start s": ("start_s", 1, 1.0),
        "steady state deg": ("steady_state_deg", 2, 1.0),
        "overshoot %": ("overshoot_percent", 1, 1.0),
        "rise s": rise,
        "settling s": ("settling_s", 2, 1.0),
    }
    source = {"truth": "true", "estimate": "estimated"}[summary["attitude_source"]]
    lines = [f"Attitude steps, judged on the {source} attitude", *columns(summary["steps"], shown)]
    if any(not step["rise_judged"] for step in summary["steps"]):
        lines.append("  * the step began at the release or during another slew; its rise time is not judged")
    return [
        *lines,
        "  rise: time from 10 to 90 % of the step; overshoot: excursion beyond the target, in % of the step;",
        f"  settling: last entry into +-{100 * SETTLING_BAND:g} % of the step around the target;",
        f"  steady state: largest error in the last {STEADY_STATE_S:g} s, for targets held for "
        f"{2 * STEADY_STATE_S:g} s or more;",
        f"  a step that ended within {SETTLING_LIMIT_S:g} s without settling is interrupted and not judged",
    ]


def _detumbling(found: Object | None) -> list[str]:
    if found is None:
        return []
    shown: dict[str, Column] = {
        "start s": ("begin_s", 1, 1.0),
        "duration s": ("duration_s", 1, 1.0),
        "first deg/s": ("first_rate_rad_s", 2, DEGREES),
        "maximum deg/s": ("largest_rate_rad_s", 2, DEGREES),
        "last deg/s": ("last_rate_rad_s", 2, DEGREES),
        "detumbled": lambda period: "yes" if period["slowed"] else "no",
    }
    known, error = found["rate_known_share"], found["rate_error_rms_rad_s"]
    return [
        f"Detumbling, rates from the {'truth' if found['rate_source'] == 'truth' else 'gyro'}",
        *columns(found["periods"], shown),
        f"  rate from the magnetometer alone: available {number(known, 1, 100.0)} % of the time, "
        f"{'' if error is None else f'{number(error, 3, DEGREES)} deg/s rms error per axis, '}"
        f"{found['restarts']} restarts",
    ]


def _knowledge(found: Object | None) -> list[str]:
    if found is None:
        return []
    share = ", ".join(f"{name} {number(part, 1, 100.0)} %" for name, part in found["share"].items())
    dipole, judged, camera = found["dipole_error_share"], found["dipole_judged_s"], found["star_camera"]
    own: list[str] = []
    errors = [  # unknown without the truth of a simulation
        f"  error of the fine attitude {number(found['fine_error_rms_rad'], 4, DEGREES)} deg rms over "
        f"three axes ({number(found['with_stars_error_rms_rad'], 4, DEGREES)} with stars), "
        f"maximum {number(found['fine_error_worst_rad'], 4, DEGREES)} deg; "
        f"maximum {number(found['worst_sigmas'], 1)} sigma per axis, "
        f"NEES per axis {number(found['nees_per_axis'])}"
    ]
    errors = errors if found["fine_error_rms_rad"] is not None else []
    if camera is not None:
        error, nees = number(camera["with_stars_error_rms_rad"], 4, DEGREES), number(camera["nees_per_axis"])
        own = [f"  error of the star camera's attitude {error} deg rms with stars, NEES per axis {nees}"]
    learned = [
        "  {}: error {} at the start, {} at the end, one sigma {}".format(
            one["name"],
            *("-" if one[key] is None else f"{one[key]:.2g}" for key in ("first_error", "error", "sigma")),
        )
        for one in found["description"]
    ]
    if learned:
        learned.insert(0, "  estimated parameters, rms (inertia divided by its trace, camera in rad):")
    return [
        "Attitude knowledge",
        f"  {share}; first fine at {number(found['fine_after_s'], 1)} s",
        *errors,
        *own,
        *learned,
        *(
            f"  error of the residual dipole in the last {number(judged[where], 1, 1.0 / 60.0)} min "
            f"in {where}: {number(share, 0, 100.0)} %"
            for where, share in dipole.items()
            if share is not None
        ),
        f"  {found['refused']} measurements and {found['fixes_refused']} fixes refused, "
        f"{found['restarts']} restarts",
    ]


def _pointing(found: Object | None) -> list[str]:
    if found is None:
        return []
    shown: dict[str, Column] = {
        "target": lambda target: str(target["target"]),
        "start s": ("begin_s", 1, 1.0),
        "duration s": ("duration_s", 1, 1.0),
        "axis deg rms": ("axis_rms_rad", 2, DEGREES),
        "maximum": ("axis_worst_rad", 2, DEGREES),
        "all axes deg rms": ("all_axes_rms_rad", 2, DEGREES),
        "V |I| mW": ("supply_w", 2, 1e3),
        "R I^2 mW": ("heat_w", 2, 1e3),
    }
    return [
        f"Pointing, {'true' if found['source'] == 'truth' else 'estimated'} attitude",
        *columns(found["targets"], shown),
        f"  errors count from {number(found['settled_after_s'], 0)} s after the start, or from the end "
        "of the first slew if that is later",
    ]


def _objects(found: list[Object]) -> list[str]:
    if not found:
        return []
    shown: dict[str, Column] = {
        "object": ("number", 0, 1.0),
        "start s": ("first_s", 1, 1.0),
        "end s": ("last_s", 1, 1.0),
        "detected in": lambda row: f"{row['seen']} of {row['frames']}",
        "minimum deg/s": ("rate_least_rad_s", 3, DEGREES),
        "maximum deg/s": ("rate_most_rad_s", 3, DEGREES),
        "V": ("magnitude", 1, 1.0),
        "sigma arcsec": ("sighting_sigma_rad", 2, ARCSECONDS),
    }
    return ["Objects among the stars", *columns(found, shown)]


def _limits(title: str, limit: str, judged: list[Object]) -> list[str]:
    if not judged:
        return []
    rows = []
    for row in judged:
        worst = number(row["worst"], 2 if row["limit"] >= 1.0 else 4)
        rows.append([row["quantity"], worst, f"{row['limit']:g} {row['unit']}", row["verdict"]])
    return [title, *table(["", "this run", limit, ""], rows)]


def _battery(found: Object | None) -> list[str]:
    if found is None:
        return []

    def charges(name: str, first: str) -> str:
        lowest, last = (number(found[f"{first}charge_{at}"], 1, 100.0) for at in ("lowest", "last"))
        return f"{name} lowest {lowest} %, at the end {last} %"

    lines = [
        charges("state of charge, estimated:", ""),
        f"estimate available {number(found['known_share'], 1, 100.0)} % of the time, "
        f"rms error {number(found['charge_error_rms'], 1, 100.0)} %",
        f"energy into the battery {number(found['in_j'], 1)} J, out of it {number(found['out_j'], 1)} J",
        "shed: " + ", ".join(f"{name} {number(time, 0)} s" for name, time in found["shed_s"].items()),
    ]
    if found["loads_j"] is not None:
        lines.insert(1, charges("state of charge, true:", "true_"))
        lines.append(
            f"true energy of the panels {number(found['solar_j'], 1)} J, "
            f"of all loads {number(found['loads_j'], 1)} J, of the coils {number(found['coils_j'], 1)} J"
        )
    return ["Battery and power system", *(f"  {line}" for line in lines)]


def _power(power: Object, thesis: bool) -> list[str]:
    """Return the report's lines on the coil power and, if `thesis` is true, on the power in the thesis."""
    if power["source"] is None:
        return []
    currents = (
        (power["peak_current_a"], "commanded"),
        (power["peak_current_actual_a"], "in the coils (truth)"),
    )
    rows = [
        (
            "supply power V |I| at the coils",
            f"average {number(power['supply_average_w'], 1, 1e3)} mW, "
            f"maximum {number(power['supply_peak_w'], 3)} W, total {number(power['supply_j'], 2)} J",
        ),
        ("supply power measured at the bus", f"average {number(power['bus_average_w'], 1, 1e3)} mW"),
        *([("consumption stated in the thesis", "average about 100 mW, maximum about 0.5 W")] * thesis),
        (
            "heat R I^2 of steady currents",
            f"average {number(power['heat_average_w'], 3, 1e3)} mW, total {number(power['heat_j'], 3)} J",
        ),
        (
            "largest current",
            ", ".join(f"{number(value, 4)} A {where}" for value, where in currents if value is not None),
        ),
    ]
    source = "currents in the coils (truth)" if power["source"] == "truth" else "commanded currents"
    return [f"Coil power, from the {source}", *(f"  {name:34}{text}" for name, text in rows)]


def _loop(summary: Object) -> list[str]:
    lines, cycles = [], summary["cycles"]
    clock = "" if summary["run"].get("realtime", True) else ", in host time; the flight ran in lock-step"
    if summary["rate_groups"]:
        shown: dict[str, Column] = {
            "rate group": lambda group: str(group["name"]),
            "period s": ("period_s", 3, 1.0),
            **{name: (name, 0, 1.0) for name in ("cycles", "slips", "overruns")},
            "mean ms": ("mean_s", 3, 1e3),
            "max ms": ("max_s", 3, 1e3),
        }
        lines += [f"Rate groups{clock}", *columns(summary["rate_groups"], shown)]
    timed = {
        "lateness of a control cycle": cycles["lateness_s"],
        "execution of a control cycle": cycles["execution_s"],
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
        lines += [f"Times{clock}", *table(["", "median ms", "99 % ms", "max ms"], rows)]
    if cycles["count"]:
        lines.append(
            f"Control cycles in the log: {cycles['count']}, missing from the log: {cycles['missing']}; "
            f"slots skipped by the loop: {cycles['skipped']}"
        )
    return lines


def _planner(plans: Object) -> list[str]:
    if not plans["plans"]:
        return []
    refusals = f" ({_tally(plans['refusals'])})" if plans["refusals"] else ""
    return [
        "Planner",
        f"  {plans['plans']} plans, {plans['accepted']} accepted ({plans['stretched']} of them stretched), "
        f"{plans['refused']} refused{refusals}",
        f"  longest horizon {number(plans['longest_horizon_s'], 1)} s, "
        f"largest planned current {number(plans['peak_current_a'], 4)} A",
    ]


def _sensing(summary: Object) -> list[str]:
    lines = []
    estimate, streaks, stars = summary["estimate"], summary["streaks"], summary["stars"]
    if estimate is not None:
        lines.append(
            f"Estimate: rms error {number(estimate['angle_rms_rad'], 3, 1e3)} mrad, "
            f"{number(estimate['rate_rms_rad_s'], 3, 1e3)} mrad/s; divided by the estimated sigma "
            f"{number(estimate['angle_normalised'])}, {number(estimate['rate_normalised'])}"
        )
    if streaks["frames"]:
        lines.append(
            f"Streaks: {streaks['frames']} frames ({_tally(streaks['status'])}), "
            f"{streaks['rates']} rates, {streaks['accepted']} used by the estimator"
        )
        lines += _errors(streaks, "x, y, z", "mrad/s", 3, 1e3, "rates")
    if stars["frames"]:
        lines.append(
            f"Stars:   {stars['frames']} frames ({_tally(stars['status'])}), {stars['tracked']} tracked, "
            f"median of {number(stars['matched'], 0)} matches, {stars['accepted']} used by the estimator"
        )
        lines += _errors(stars, "about x, y, z", "arcsec", 2, ARCSECONDS, "attitudes")
    lines += _star_camera(summary["star_camera"])
    lines += _lens(summary["lens"])
    return lines + _failed_frames(summary["failed_frames"])


def _failed_frames(frames: list[Object]) -> list[str]:
    """Return a table of frames without a measurement; successive frames with the same cause share a line."""
    if not frames:
        return []
    causes = [(frame["streaks"], frame["stars"] or "-") for frame in frames]
    rows = []
    for (streaks, stars), group in groupby(zip(causes, frames, strict=True), key=lambda pair: pair[0]):
        exposed = [frame["exposed_s"] for _, frame in group]
        rows.append([str(len(exposed)), number(exposed[0], 1), number(exposed[-1], 1), streaks, stars])
    more = len(rows) - _MAX_LISTED
    head = ["frames", "first at s", "last at s", "streaks", "stars"]
    lines = [f"Frames without rate or attitude: {len(frames)}", *table(head, rows[:_MAX_LISTED])]
    return lines + ([f"  and {more} more lines; --json lists all frames"] if more > 0 else [])


def _star_camera(found: Object | None) -> list[str]:
    if found is None:
        return []
    share = f" ({number(found['share'], 1, 100.0)} %)" if found["share"] is not None else ""
    return [
        f"Star camera: attitude or rate at {found['measured']} of {found['unobstructed']} unobstructed "
        f"exposures{share}; longest gap {number(found['longest_gap_s'], 0)} s",
        f"  {found['instants']} scheduled exposures, {found['slow']} of them below camera.max_rate; "
        "unobstructed: below it and outside the cones of Sun and Earth (pointing.cones)",
    ]


def _lens(found: Object | None) -> list[str]:
    if found is None:
        return []
    axes = zip(found["centre_px"], found["centre_sigma_px"], strict=True)
    focal, x, y, psf = (
        " +- ".join(map(number, pair)) for pair in (found["focal_length_px"], *axes, found["psf_sigma_px"])
    )
    delay = " +- ".join(number(time, 2, 1e6) for time in found["line_time_s"])
    return [
        f"Learned lens: focal length {focal} px, optical axis {x}, {y} px, distance of a corner from the "
        f"centre +- {number(found['corner_sigma'], 4, 100.0)} %",
        f"  line time {delay} us, point spread {psf} px; from {found['frames']} frames, "
        f"{found['contradictions']} contradictions",
    ]


def _errors(found: Object, axes: str, unit: str, digits: int, scale: float, what: str) -> list[str]:
    """Return the line of the rms errors against the truth, or nothing if the errors are unknown."""
    if found["rms_error"] is None:
        return []
    errors = ", ".join(number(error, digits, scale) for error in found["rms_error"])
    return [
        f"  rms error {axes} {errors} {unit} over {found['compared']} {what}; "
        f"NEES per axis {number(found['normalised'])}"
    ]


def _modes(modes: list[Object]) -> list[str]:
    if not modes:
        return []
    rows = [[mode["mode"], number(mode["at_s"], 3), mode["trigger"], mode["reason"] or "-"] for mode in modes]
    return ["Modes", *table(["", "start s", "trigger", "reason"], rows)]


def _health(health: Object | None) -> list[str]:
    if health is None:
        return []
    good = ", ".join(f"{name} {number(share, 1, 1e2)} %" for name, share in health["streams_good"].items())
    lines = [
        f"Health: share of time with good readings: {good}",
        f"  conditions detected: {', '.join(health['facts']) or 'none'}; "
        f"watchdog fed {health['watchdog_fed']} times, wall clock set {health['clock_steps']} times",
    ]
    if health["proportional_bytes"] is not None:
        known = (
            ("cpu_share", 2, 1.0, "maximum {} of a core"),
            ("proportional_bytes", 0, 2.0**-20, "{} MiB"),
            ("temperature_c", 1, 1.0, "{} deg C"),
            ("memory_slope_bytes_per_hour", 2, 2.0**-20, "memory slope {} MiB/h"),
            ("disk_free_bytes", 0, 2.0**-20, "{} MiB of disk free"),
        )
        shown = [
            phrase.format(number(health[key], digits, scale))
            for key, digits, scale, phrase in known
            if health[key] is not None
        ]
        lines.append("  " + ", ".join(shown))
    return lines


def _events(events: list[Object]) -> list[str]:
    if not events:
        return []
    names = dict(SEVERITIES)
    shown: dict[str, Column] = {
        "": lambda event: str(event["name"]),
        "severity": lambda event: names.get(event["severity"], str(event["severity"])),
        "count": ("count", 0, 1.0),
        "first at s": ("first_s", 3, 1.0),
    }
    return ["Events", *columns(events, shown)]


def _coils(judged: list[Object]) -> list[str]:
    if not judged:
        return []
    return ["Coils", *(f"  {number(one['time_s'], 1)} s  {one['name']}: {one['text']}" for one in judged)]


def _logs(logs: list[Object]) -> list[str]:
    counts = "packets bytes skipped_bytes truncated_bytes missing_packets other_versions dropped_segments"
    shown: dict[str, Column] = {key.replace("_", " "): (key, 0, 1.0) for key in counts.split()}
    return ["Log integrity", *columns(logs, {"log": lambda log: str(log["log"]), **shown})]


def _tally(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
