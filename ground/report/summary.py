"""A run in one object, ready for JSON: what `flight report --json` prints and the text report is made from.

`None` stands for a value that is unknown, does not apply or was never reached; `notes` say which.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flight.link.telemetry.packets import to_text
from flight.schema import reader
from flight.schema.errors import ConfigError
from flight.schema.orbit import OrbitConfig, as_orbit
from ground.report import performance as limits
from ground.report.detumbling import detumbling
from ground.report.knowledge import knowledge
from ground.report.objects import objects
from ground.report.operations import (
    cycles,
    events,
    health,
    jobs,
    logs,
    modes,
    planner,
    rate_groups,
    step_ends,
)
from ground.report.performance import Command, Response, commands, interrupted, placed, response
from ground.report.pointing import pointing
from ground.report.requirements import judge, required
from ground.report.sensing import estimate_errors, failed_frames, star_attitudes, streaks
from ground.report.signals import Attitude, bus_power, coil_power, estimated_attitude, seconds, true_attitude
from ground.telemetry.reader import Run
from knightcube.astro.arrays import FloatArray

Object = dict[str, Any]


@np.errstate(all="ignore")  # a packet may hold any number: results that are not finite become None
def summarise(run: Run) -> Object:
    """Return all values of the report; only None, bool, int, float, str, list and dict."""
    attitude = true_attitude(run) or estimated_attitude(run)
    notes: list[str] = []
    identity = _identity(run, attitude, notes)
    in_orbit = len(run["spin"]) > 0
    steps = [] if in_orbit else _steps(run, attitude, identity["duration_planned_s"], notes)
    power = _power(run, notes)
    braked, known = detumbling(run), knowledge(run)
    config = _orbit_config(run, notes) if in_orbit else None
    pointed = None if config is None else pointing(run, config.pointing.axis, coil_power(run))
    summary: Object = {
        "run": identity,
        "attitude_source": attitude.source,
        "steps": [_step_row(*step) for step in steps],
        "detumbling": braked,
        "knowledge": known,
        "pointing": pointed,
        "requirements": [] if config is None else required(config, braked, known, pointed),
        "thesis": [] if in_orbit else _against_thesis([(c, r) for c, r in steps if r is not None], power),
        "power": power,
        "rate_groups": rate_groups(run["rate_group"]),
        "cycles": cycles(run["cycle_timing"], run["control"]),
        "jobs": jobs(run["job_timing"]),
        "planner": planner(run["plan"]),
        "estimate": estimate_errors(run),
        "streaks": streaks(run),
        "stars": star_attitudes(run),
        "failed_frames": failed_frames(run),
        "objects": objects(run),
        "modes": modes(run["mode"]),
        "health": health(run["health"]),
        "events": events(run["event"]),
        "logs": logs(run),
        "notes": notes,
    }
    plain: Object = _plain(summary)
    return plain


def _orbit_config(run: Run, notes: list[str]) -> OrbitConfig | None:
    """Return the configuration that was flown, None where its copy beside the log cannot be read."""
    path = run.folder / "config.yaml"
    try:
        if path.exists():
            return as_orbit(reader.load(path))
        why = "no copy of the configuration beside the log"
    except ConfigError as error:
        why = str(error)
    notes.append(f"pointing and requirements not judged: {why}")
    return None


def _plain(value: Any) -> Any:
    """Return `value` with numpy's types made Python's, and NaN and infinity made None."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _identity(run: Run, attitude: Attitude, notes: list[str]) -> Object:
    """Return what was flown, and for how long."""
    ends = [seconds(run[name])[-1] for name in ("control", "truth", "event") if len(run[name])]
    identity: Object = {"folder": str(run.folder), "duration_s": max(ends, default=0.0), "cut_short": False}
    if attitude.source == "estimate":
        notes.append("no truth log: judged on the estimate")
    if not len(run["run"]):
        notes.append("no run packet: the configuration of this run is not known")
        return {**identity, "duration_planned_s": math.nan}
    first = run["run"][0]
    period = float(first["control_period_ns"]) * 1e-9
    planned = float(first["duration"])
    cut_short = bool(planned - identity["duration_s"] > 3.0 * period)
    if cut_short:
        notes.append(f"cut short: {identity['duration_s']:.1f} s of {planned:.1f} s")
    return {
        **identity,
        "cut_short": cut_short,
        "duration_planned_s": planned,
        "config_name": to_text(first["config_name"]),
        "config_crc": int(first["config_crc"]),
        "software": to_text(first["software"]),
        "seed": int(first["seed"]),
        "utc_ns": int(first["utc_ns"]),
        "simulated": bool(first["simulated"]),
        "realtime": bool(first["realtime"]),
        "control_period_s": period,
    }


def _steps(
    run: Run, attitude: Attitude, planned_end: float, notes: list[str]
) -> list[tuple[Command, Response | None]]:
    """Return each commanded step with its response, None where it was interrupted or not observed."""
    targets = run["target"]
    if not len(targets):
        notes.append("no target packets: no steps to judge")
        return []
    if len(attitude.time) < 2:
        notes.append("no attitude: no steps can be judged")
        return []
    times = seconds(targets)
    seen_until = float(attitude.time[-1])
    release = float(np.interp(times[0], attitude.time, attitude.q2))
    end = _end_of_last_step(times, planned_end, seen_until)
    listed = commands(targets["index"].tolist(), times, targets["q2"].astype(float), release, end)
    listed = placed(listed, attitude.time, attitude.q2, step_ends(run["mode"]))
    sample = 3.0 * float(np.median(np.diff(attitude.time)))
    steps: list[tuple[Command, Response | None]] = []
    for command in listed:
        seen = attitude.time[0] - sample <= command.time
        complete = seen and command.time + command.duration <= seen_until + sample
        found = response(attitude.time, attitude.q2, command) if complete else None
        if found is not None and interrupted(command, found):
            found = None
            notes.append(f"step {command.index}: interrupted after {command.duration:.1f} s, not judged")
        else:
            notes += _remarks(command, found)
        steps.append((command, found))
    return steps


def _remarks(command: Command, found: Response | None) -> list[str]:
    """Return what the missing numbers of a step mean."""
    if found is None:
        return [f"step {command.index}: not complete, not judged"]
    if math.isnan(found.settling_s):
        return [f"step {command.index}: the target stays where it was, only the steady state is judged"]
    short = math.isnan(found.steady_state_deg)
    remarks = [f"step {command.index}: too short for a steady state to be judged"] if short else []
    never = {"rise_s": "reached 90 %", "settling_s": "settled"}
    return remarks + [
        f"step {command.index}: never {what}"
        for name, what in never.items()
        if math.isinf(getattr(found, name))
    ]


def _end_of_last_step(times: FloatArray, planned_end: float, seen_until: float) -> float:
    """Return when the last target's time is up: the run's planned end, else as long as the longest before."""
    if math.isfinite(planned_end):
        return max(planned_end, float(times[-1]))
    return float(times[-1] + np.max(np.diff(times))) if len(times) > 1 else max(seen_until, float(times[-1]))


def _rise_is_judged(command: Command) -> bool:
    """Return whether the thesis bounds this rise: a step between targets, not a slew from elsewhere."""
    return command.index > 0 and command.from_target


def _step_row(command: Command, found: Response | None) -> Object:
    none = Response(math.nan, math.nan, math.nan, math.nan)
    answer = found or none
    return {
        "index": command.index,
        "again": command.again,
        "start_s": command.time,
        "duration_s": command.duration,
        "complete": found is not None,
        "from_q2": command.start,
        "from_target": command.from_target,
        "target_q2": command.target,
        "steady_state_deg": answer.steady_state_deg,
        "overshoot_percent": answer.overshoot_percent,
        "rise_s": answer.rise_s,
        "rise_judged": _rise_is_judged(command),
        "settling_s": answer.settling_s,
    }


def _power(run: Run, notes: list[str]) -> Object:
    """Return the coils' power from their supply, R I^2 of their mean currents, and the largest currents."""
    written = np.abs(run["control"]["current_written"])
    actual = np.abs(run["truth"]["current"])
    _, measured = bus_power(run)
    found: Object = {
        "bus_average_w": float(measured.mean()) if len(measured) else math.nan,
        "peak_current_a": float(written.max()) if written.size else math.nan,
        "peak_current_actual_a": float(actual.max()) if actual.size else math.nan,
    }
    power = coil_power(run)
    if power is None or power.duration <= 0.0:
        notes.append("power not known: neither truth nor coil resistance in the log")
        return {
            **found,
            "source": None,
            "supply_average_w": math.nan,
            "supply_peak_w": math.nan,
            "supply_j": math.nan,
            "heat_average_w": math.nan,
            "heat_j": math.nan,
        }
    return {
        **found,
        "source": power.source,
        "supply_average_w": power.average(power.supply),
        "supply_peak_w": float(power.supply.max()),
        "supply_j": power.energy(power.supply),
        "heat_average_w": power.average(power.heat),
        "heat_j": power.energy(power.heat),
    }


def _against_thesis(steps: list[tuple[Command, Response]], power: Object) -> list[Object]:
    """Return the worst of each figure beside the thesis's bound."""
    judged = [r.rise_s for c, r in steps if _rise_is_judged(c)]
    responses = [r for _, r in steps]
    return [
        judge(
            "steady-state error",
            [r.steady_state_deg for r in responses],
            limits.STEADY_STATE_LIMIT_DEG,
            "deg",
        ),
        judge("overshoot", [r.overshoot_percent for r in responses], limits.OVERSHOOT_LIMIT_PERCENT, "%"),
        judge("rise time", judged, limits.RISE_LIMIT_S, "s"),
        judge("settling time", [r.settling_s for r in responses], limits.SETTLING_LIMIT_S, "s"),
        *(
            judge(f"average supply power at the {place}", [average], limits.AVERAGE_SUPPLY_POWER_LIMIT_W, "W")
            for place, average in (("coils", power["supply_average_w"]), ("bus", power["bus_average_w"]))
        ),
        judge("largest current", [power["peak_current_a"]], limits.CURRENT_LIMIT_A, "A"),
    ]
