"""Report of a run as one object, printed by `report --json` and written as text by `ground.report.text`.

`None` means that a value is unknown, not applicable or was never reached. The section `notes` gives the
reasons for values that are `None`.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np

from flight.link import events
from flight.link.telemetry.definitions import CONTROL, MODES, SHED
from flight.link.telemetry.packets import LAYOUTS, SEQUENCE_MODULUS, PacketArray
from flight.loop.facts import FACTS, StreamState
from flight.schema import reader
from flight.schema.bodies import OrbitConfig, as_orbit
from flight.schema.document import ConfigError
from ground.identification.orbit import learned_lens
from ground.report import signals
from ground.report.orbit import detumbling, knowledge, objects, pointing, requirements, star_camera
from ground.report.steps import against_thesis, judged_steps, step_row
from ground.telemetry import Run, named, text_of
from knightcube.astro.arrays import FloatArray

Object = dict[str, Any]
_LOST_S = 2.0
"""Longest time (s) by which the flight log may end before the truth log without a note on lost packets."""
_TRUE_POWER_S = 1.0
"""Interval (s) of the packets `true_power`."""


@np.errstate(all="ignore")  # packets may contain any numbers; results that are not finite become None
def summarise(run: Run) -> Object:
    """Return all values of the report, which contains only None, bool, int, float, str, list and dict."""
    attitude = signals.true_attitude(run) or signals.estimated_attitude(run)
    notes: list[str] = []
    identity = _identity(run, attitude, notes)
    config, unread = _orbit_config(run)
    in_orbit = config is not None or len(run["spin"]) > 0
    if in_orbit and unread:
        notes.append(f"pointing and requirements not judged: {unread}")
    steps = [] if in_orbit else judged_steps(run, attitude, identity["duration_planned_s"], notes)
    power = signals.coil_power(run)
    powers = _power(run, power, notes)
    detumbled, known = detumbling(run), knowledge(run)
    pointed = None if config is None else pointing(run, config.pointing.axis, power)
    seen = None if config is None else star_camera(run, config)
    required = []
    if config is not None:
        required = requirements(config, detumbled, known, pointed, seen, identity["duration_s"])
    summary: Object = {
        "run": identity,
        "attitude_source": attitude.source,
        "steps": [step_row(*step) for step in steps],
        "detumbling": detumbled,
        "knowledge": known,
        "pointing": pointed,
        "requirements": required,
        "thesis": [] if in_orbit else against_thesis(steps, powers),
        "power": powers,
        "rate_groups": _rate_groups(run["rate_group"]),
        "cycles": _cycles(run["cycle_timing"], run["control"]),
        "jobs": _jobs(run["job_timing"]),
        "planner": _planner(run["plan"]),
        "estimate": signals.estimate_errors(run),
        "streaks": signals.streaks(run),
        "stars": signals.star_attitudes(run),
        "star_camera": seen,
        "lens": learned_lens(run),
        "failed_frames": signals.failed_frames(run),
        "objects": objects(run),
        "modes": _modes(run["mode"]),
        "health": _health(run["health"]),
        "events": _events(run["event"]),
        "coils": _coils(run["event"]),
        "logs": _logs(run),
        "notes": [*notes, *_damage(run)],
    }
    if len(run["power"]):
        summary["battery"] = _battery(run)
    plain: Object = _plain(summary)
    return plain


def _damage(run: Run) -> list[str]:
    """Return a note for each log from which packets are missing before its end."""
    return [
        f"the {stem} log is damaged: {sum(log.missing.values())} packets are missing, "
        f"{log.skipped_bytes} bytes belong to no packet; the results are those of the packets that were found"
        for stem, log in run.logs.items()
        if log.skipped_bytes or sum(log.missing.values())
    ]


def _plain(value: Any) -> Any:
    """Return `value` with Python types instead of numpy types, and None instead of NaN and infinity."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _orbit_config(run: Run) -> tuple[OrbitConfig | None, str]:
    """Return the configuration of a satellite, or None and the reason why it cannot be read."""
    path = run.folder / "config.yaml"
    try:
        return (as_orbit(reader.load(path)), "") if path.exists() else (None, f"{path} does not exist")
    except ConfigError as error:
        return None, str(error)


def _identity(run: Run, attitude: signals.ThreadMotion, notes: list[str]) -> Object:
    identity: Object = {"folder": str(run.folder), "duration_s": signals.last_time(run), "cut_short": False}
    if attitude.source == "estimate":
        notes.append("no truth log: judged on the estimate")
    behind = float(signals.seconds(run["truth"])[-1]) - identity["duration_s"] if len(run["truth"]) else 0.0
    if behind > _LOST_S:
        # In real time, the emulated devices run some seconds longer than a flight process that was killed.
        stopped = events.STOPPED.code in run["event"]["code"]
        killed = not stopped and bool(np.any(run["run"]["realtime"]))
        cause = "the flight process died, or its" if killed else "its"
        notes.append(
            f"the flight log ends {behind:.1f} s before the truth log: {cause} last packets are lost"
        )
    if not len(run["run"]):
        notes.append("no run packet: the configuration of this run is not known")
        return {**identity, "duration_planned_s": math.nan}
    first = run["run"][0]
    period = float(first["control_period_ns"]) * 1e-9
    planned = float(first["duration"])
    cut_short = bool(planned - identity["duration_s"] > 3.0 * period)
    if cut_short:
        notes.append(f"cut short: {identity['duration_s']:.1f} s of {planned:.1f} s")
    if identity["duration_s"] == 0.0 and not len(run["control"]):
        notes.append("stopped before the first control cycle")
    return {
        **identity,
        "cut_short": cut_short,
        "duration_planned_s": planned,
        "config_name": text_of(first["config_name"]),
        "config_crc": int(first["config_crc"]),
        "software": text_of(first["software"]),
        "seed": int(first["seed"]),
        "utc_ns": int(run["run"]["utc_ns"][-1]),
        "simulated": bool(first["simulated"]),
        "realtime": bool(first["realtime"]),
        "control_period_s": period,
    }


def _power(run: Run, power: signals.PowerHistory | None, notes: list[str]) -> Object:
    # The truth packets have only the first three coils.
    six = run["true_coil_currents"]
    actual = np.abs((six if len(six) else run["truth"])["current"])
    written = np.abs(run["control"]["current_written"])
    measured = signals.bus_power(run)[1]
    sums = ("supply_average_w", "supply_peak_w", "supply_j", "heat_average_w", "heat_j")
    found: Object = {
        "bus_average_w": float(measured.mean()) if len(measured) else math.nan,
        "peak_current_a": float(written.max()) if written.size else math.nan,
        "peak_current_actual_a": float(np.fmax.reduce(actual, axis=None, initial=math.nan)),
        "source": None,
        **dict.fromkeys(sums, math.nan),
    }
    if power is None or power.spans.sum() <= 0.0:
        notes.append("power not known: the log has neither the truth nor the currents of the coils")
        return found
    supply = power.average(power.supply), float(power.supply.max()), power.energy(power.supply)
    heat = power.average(power.heat), power.energy(power.heat)
    return {**found, "source": power.source, **dict(zip(sums, supply + heat, strict=True))}


def _rate_groups(packets: PacketArray) -> list[Object]:
    """Return the final counters of each rate group, fastest first."""
    last = {text_of(row["name"]): row for row in packets}
    groups: list[Object] = [
        {
            "name": name,
            "period_s": float(row["period"]),
            **{counter: int(row[counter]) for counter in ("cycles", "slips", "overruns")},
            "mean_s": float(row["mean"]),
            "max_s": float(row["max"]),
        }
        for name, row in last.items()
    ]
    return sorted(groups, key=lambda group: float(group["period_s"]))


def _cycles(timing: PacketArray, control: PacketArray) -> Object:
    """Return the numbers of control cycles and statistics of their times.

    The value `count` is the number of cycles in the log, `missing` that of the cycles absent from the log
    according to the sequence counts, and `skipped` that of the slots in which the loop ran no cycle.
    """
    absent = np.maximum(np.diff(control["cycle"].astype(np.int64)) - 1, 0)
    counts = LAYOUTS[CONTROL.name].sequence_counts(control.tobytes())
    # Sequence counts do not show gaps of multiples of their range: such cycles count as missing.
    skipped = np.maximum(absent - (np.diff(counts) - 1) % SEQUENCE_MODULUS, 0) % SEQUENCE_MODULUS
    return {
        "count": len(control),
        "missing": int(np.sum(absent - skipped)),
        "skipped": int(np.sum(skipped)),
        "lateness_s": _percentiles(timing["lateness"].astype(float)),
        "execution_s": _percentiles(timing["execution"].astype(float)),
    }


def _percentiles(values: FloatArray) -> Object | None:
    if not len(values):
        return None
    p50, p99 = np.percentile(values, [50.0, 99.0])
    return {"p50": float(p50), "p99": float(p99), "max": float(values.max())}


def _jobs(packets: PacketArray) -> list[Object]:
    names = np.array([text_of(name) for name in packets["name"]], dtype=object)
    found = []
    for name in sorted(set(names)):
        own = packets[names == name]
        outcomes = Counter(text_of(outcome) for outcome in own["outcome"])
        times = _percentiles(own["execution"].astype(float))
        found.append({"name": name, "count": len(own), "outcomes": dict(outcomes), "execution_s": times})
    return found


def _planner(packets: PacketArray) -> Object:
    """Return the numbers of plans: accepted, with an extended horizon, and refused for each reason."""
    accepted = packets["accepted"] == 1
    status = np.array([text_of(value) for value in packets["status"]], dtype=object)
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


def _modes(packets: PacketArray) -> list[Object]:
    return [
        {
            "mode": named(MODES, row["mode"]),
            "at_s": float(time),
            "trigger": text_of(row["trigger"]),
            "reason": text_of(row["reason"]),
        }
        for row, time in zip(packets, signals.seconds(packets), strict=True)
    ]


def _health(packets: PacketArray) -> Object | None:
    """Return stream availability, active conditions and resources, or None without health packets."""
    if not len(packets):
        return None
    streams = {
        name: float(np.mean(packets[name] == StreamState.GOOD))
        for name in ("imu", "field", "coils", "power", "camera")
        if (packets[name] != StreamState.NOT_FITTED).any()
    }
    held = int(np.bitwise_or.reduce(packets["facts"].astype(np.uint64)))

    def known(name: str) -> FloatArray:
        values: FloatArray = packets[name][np.isfinite(packets[name])]
        return values if len(values) else np.array([math.nan])

    return {
        "streams_good": streams,
        "facts": [fact.name for bit, fact in enumerate(FACTS) if held >> bit & 1],
        "watchdog_fed": int(packets["fed"][-1]),
        "clock_steps": int(packets["clock_steps"][-1]),
        "cpu_share": float(known("cpu_share").max()),
        "proportional_bytes": float(known("proportional").max()),
        "memory_slope_bytes_per_hour": float(known("memory_slope")[-1]) * 3600.0,
        "disk_free_bytes": float(known("disk_free")[-1]),
        "temperature_c": float(known("temperature").max()),
    }


def _events(packets: PacketArray) -> list[Object]:
    """Return the events by name in order of first appearance, with counts that include throttled events."""
    found: dict[str, Object] = {}
    for row, time in zip(packets, signals.seconds(packets), strict=True):
        name, text = text_of(row["name"]), text_of(row["text"])
        first = {"name": name, "count": 0, "severity": int(row["severity"]), "first_s": float(time)}
        found.setdefault(name, {**first, "text": text})["count"] += 1 + int(row["suppressed"])
    return list(found.values())


def _battery(run: Run) -> Object:
    """Return state of charge, energies and load shedding; true values are NaN without a truth log."""
    packets, true, times = run["power"], run["true_power"], signals.seconds(run["power"])
    charge = packets["charge"].astype(float)
    known = charge[np.isfinite(charge)]
    steps = np.append(np.diff(times), 0.0)
    found: Object = {
        "charge_lowest": float(known.min()) if len(known) else math.nan,
        "charge_last": float(charge[-1]),
        "known_share": float(np.mean(np.isfinite(charge))),
        "in_j": float(packets["energy_in"][-1]),
        "out_j": float(packets["energy_out"][-1]),
        "shed_s": {name: float(steps[packets["shed"] >= level].sum()) for level, name in SHED if level},
    }
    names = ("charge_error_rms", "true_charge_lowest", "true_charge_last", "solar_j", "loads_j", "coils_j")
    found |= dict.fromkeys(names, math.nan)
    if len(true):
        judged = signals.within_truth(true, packets)
        at = np.interp(signals.seconds(judged), signals.seconds(true), true["charge"].astype(float))
        errors = judged["charge"] - at
        errors = errors[np.isfinite(errors)]
        rms = float(np.sqrt(np.mean(errors**2))) if len(errors) else math.nan
        # A packet's power (W) applies to the time since the previous packet, or to 1 s in the first packet.
        spans = np.diff(signals.seconds(true), prepend=signals.seconds(true)[0] - _TRUE_POWER_S)
        sums = [float(spans @ true[f"{name}_power"].astype(float)) for name in ("solar", "load", "coil")]
        values = [rms, float(true["charge"].min()), float(true["charge"][-1]), *sums]
        found |= dict(zip(names, values, strict=True))
    return found


_OF_COILS = {events.COIL_BROKEN.name, events.COIL_CORRECTED.name, events.COIL_TRUSTED.name}


def _coils(packets: PacketArray) -> list[Object]:
    """Return time, name and text of the events by which a coil is isolated, corrected or used again."""
    rows = ((float(time), row) for row, time in zip(packets, signals.seconds(packets), strict=True))
    named = ((time, text_of(row["name"]), text_of(row["text"])) for time, row in rows)
    return [{"time_s": time, "name": name, "text": text} for time, name, text in named if name in _OF_COILS]


def _logs(run: Run) -> list[Object]:
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
