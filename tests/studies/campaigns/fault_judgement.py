"""Evaluation of a run of campaign `faults` by its log and its true states.

The tables have the event and the reaction that each fault must cause. A fault counts as reported only if a
specific event reports it. For instance, a stuck coil also causes a tumbling event, but that event does not
name the failed part. If the table of events states a reaction, the reaction must follow. Times are determined
from log and truth, not from events alone, because events are rate-limited.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from flight.link.events import EVENTS, EventKind, Reaction, Severity
from flight.link.telemetry.packets import to_text
from ground.campaigns.runner import Result
from ground.telemetry import Run
from knightcube.astro.arrays import BoolArray, FloatArray
from sim_hal.faults.catalogue import FaultKind
from sim_hal.settings import FaultEntry
from tests.support.flights import FRAME_EXPOSURE, FRAME_LATE, FRAME_PERIOD, demo_world

_STARS = {"stars-refused", "streak-refused", "vision-failed"}

OWN: Mapping[str, frozenset[str]] = {
    "imu": frozenset(
        {"imu-silent", "imu-corrupt", "imu-implausible", "imu-line-lost", "imu-refused", "imu-unusable"}
        | {"gyro-lost", "imu-upset"}
    ),
    "pwm": frozenset({"coil-fault"}),
    "bus": frozenset({"coil-fault", "power-fault"}),
    "monitor": frozenset({"power-fault", "power-doubted", "coil-suspect"}),
    "coil": frozenset({"coil-broken", "coil-corrected", "coil-suspect"}),
    "bridge": frozenset({"coil-broken", "coil-suspect"}),
    "camera": frozenset(
        {"camera-lost", "camera-frozen", "camera-black", "camera-saturated"}
        | {"camera-torn", "camera-strange", "camera-late"}
        | _STARS
    ),
    "planner": frozenset({"planner-busy", "planner-failed", "plan-refused", "holding"}),
    "vision": frozenset({"vision-slow"} | _STARS),
    "clock": frozenset({"clock-step"}),
    "disk": frozenset({"log-fault"}),
}
"""Events that report a fault of a device."""

COIL_JUDGED = frozenset({"coil-broken", "coil-corrected"})
"""Events by which a broken coil is isolated, or the sign of a reversed coil is changed."""

OWN_OF_KIND: dict[str, frozenset[str]] = {
    # The packets are valid, but too few or too old for control, so only the event of the stream is reported.
    "imu: slow": OWN["imu"] | {"stream-poor"},
    "imu: delayed": OWN["imu"] | {"stream-poor"},
    "imu: intermittent": OWN["imu"] | {"stream-poor"},
    "imu: cut": OWN["imu"] | {"stream-poor"},
}
"""Events that report a fault, for kinds of fault whose events differ from those of their part in `OWN`."""

REACTION: Mapping[str, str] = {
    "imu": "control-lost",
    "pwm": "coil-fault",
    "bus": "coil-fault",
    "coil": "coil-broken",
    "bridge": "coil-broken",
}
"""Event whose reaction in the table of events (coils off, or isolation) must follow."""


def part_of(kind: FaultKind) -> str:
    """Return the name of the faulty device in the tables; the coils of all axes share one entry."""
    return kind.device.partition("-")[0]


def own_events(kind: FaultKind) -> frozenset[str]:
    """Return the names of the events that report a fault."""
    return OWN_OF_KIND.get(kind.name, OWN[part_of(kind)])


CYCLE = 0.025
REPORTED_WITHIN = 20.0
"""Longest time (s) after the end of a fault until its event; later events have another cause."""
BLIND_GRACE = 0.1
"""Longest time (s) from the last measurement to zero coil current."""
ZERO = 1e-3
"""Largest current (A) of a coil that is off."""
FRAME_READOUT = 0.05
"""Readout time (s) of the camera."""
DRIVEN = 6.0e-3
"""Smallest current (A) at which the monitor can evaluate a driven coil."""

OFF_SURELY, GAIN_ERROR = 0.015, 0.2
"""Largest absolute (A) and relative differences, due to noise, of two readings of the same current."""
LOOKED_FROM, LOOKED = 2.0, 3.0
"""Start (s) of the monitor's complete mean, and longest time (s) from a bit flip to its effect.
"""
FEW = 3
"""Largest difference in the number of IMU samples that does not count as an effect."""
BACK_WITHIN = 2.0
"""Longest recovery time (s) of a device after it responds again."""
_OUT_OF_REACH = {"nack", "slow", "intermittent"}
EVENT_KINDS: dict[str, EventKind] = {kind.name: kind for kind in EVENTS}


def events_of(flown: Run) -> list[tuple[float, str, str]]:
    """Return time (s), name and text of each event."""
    return [(float(e["time_ns"]) * 1e-9, to_text(e["name"]), to_text(e["text"])) for e in flown["event"]]


def duration_of(flown: Run) -> float:
    """Return the planned duration (s) of a flight, from its configuration."""
    return float(flown["run"]["duration"][0])


def warnings_in(
    reported: Sequence[tuple[float, str, str]], at: float, end: float, duration: float
) -> list[tuple[float, str, str]]:
    """Return the warnings that a fault from `at` to `end` s can have caused in a flight of `duration` s."""
    return [
        (time, name, text)
        for time, name, text in reported
        if at - 1e-6 <= time < min(end + REPORTED_WITHIN, duration - CYCLE)
        and EVENT_KINDS[name].severity is not Severity.INFORMATION
    ]


def judge(flown: Run, kind: FaultKind, entry: FaultEntry) -> Result:
    """Return the evaluation of a fault from the logs of its flight."""
    at, duration = entry.at or 0.0, duration_of(flown)
    span = duration - at if entry.span is None else entry.span
    end = at if kind.momentary else min(at + span, duration)
    reported = events_of(flown)
    warned = [(time, name) for time, name, _ in warnings_in(reported, at, end, duration)]
    own = [(time, name) for time, name in warned if name in own_events(kind)]
    reactions = {EVENT_KINDS[name].reaction for _, name in warned} - {Reaction.NOTE}
    control = flown["control"]
    return {
        "at": at,
        "end": end,
        "exercised": bool(own) or _is_exercised(flown, kind, at, end),
        "detected_s": own[0][0] - at if own else None,
        "event": own[0][1] if own else None,
        "others": sorted({name for _, name in warned} - own_events(kind)),
        "reaction_right": _reaction_right(flown, kind, at, end, warned),
        "reported": list(dict.fromkeys(name for _, name in warned)),
        "reactions": sorted(reaction.name.lower().replace("_", " ") for reaction in reactions),
        "recovered_s": _recovered(flown, kind, at, end, reported),
        "blind_current_a": _blind_current(flown, part_of(kind) == "imu"),
        "largest_current_a": float(np.abs(flown["truth"]["current"]).max()),
        "task_failed": any(name == "task-failed" for _, name, _ in reported),
        "service_failing": any(name == "service-failing" for _, name, _ in reported),
        "log_intact": all(log.intact for log in flown.logs.values())
        and len(control) == round(duration / CYCLE),
    }


def _is_exercised(flown: Run, kind: FaultKind, at: float, end: float) -> bool:
    """Return whether the faulty part was in use during its fault."""
    control = flown["control"]
    time = control["time_ns"] * 1e-9
    inside = (time >= at) & (time < max(end, at + 1.0))
    written = np.abs(control["current_written"][inside])
    device, _, axis = kind.device.partition("-")
    if device in {"coil", "bridge"}:
        return _is_driven(control["current_written"][inside][:, "xyz".index(axis)], kind.kind)
    if kind.name in {"pwm: stuck", "pwm: delayed", "pwm: bits"}:
        return bool((written > DRIVEN).any(axis=1).sum() * CYCLE > 1.0)
    if kind.name == "monitor: wrong":
        asked = written.sum(axis=1)
        return bool(differs(asked, (kind.parameters["gain"].default or 0.0) * asked).sum() * CYCLE > 1.0)
    if kind.name == "monitor: delayed":
        return _is_behind(flown, kind, inside)
    if kind.kind == "upset" or device == "camera":
        return _is_upset(flown, device, at) if kind.kind == "upset" else _is_frame_spoiled(kind.kind, at, end)
    return device not in {"planner", "vision"} or _is_worker_busy(flown, kind, at, end)


def _is_driven(own: FloatArray, kind: str) -> bool:
    """Return whether a broken coil or bridge was driven for long enough, from the commanded currents (n,), A.

    A leg that is stuck low has an effect only if it should be high: leg A at positive currents, leg B at
    negative currents.
    """
    driven = {"a-low": own > DRIVEN, "b-low": own < -DRIVEN}.get(kind, np.abs(own) > DRIVEN)
    return kind.endswith("high") or bool(driven.sum() * CYCLE > 2.5)


def _is_worker_busy(flown: Run, kind: FaultKind, at: float, end: float) -> bool:
    """Return whether a worker ran a job during its fault."""
    jobs = flown["job_timing"]
    when = jobs["time_ns"] * 1e-9
    mine = np.array([to_text(name) == kind.device for name in jobs["name"]], dtype=bool)
    if kind.kind == "endless":  # a running job exceeded its time limit
        return bool((mine & (when >= at) & (jobs["outcome"] == b"timed-out")).any())
    # A result is reported after its modelled latency.
    begun = when - getattr(demo_world().latency, kind.device)
    return bool((mine & (begun >= at - 1e-6) & (begun < end)).any())


def _is_behind(flown: Run, kind: FaultKind, inside: BoolArray) -> bool:
    """Return whether the commands differed from the stuck reading for at least a second."""
    asked = np.abs(flown["control"]["current_written"]).sum(axis=1)
    behind = round((kind.parameters["delay"].default or 0.0) / CYCLE)
    before = np.concatenate([np.full(behind, asked[0]), asked[:-behind]])
    return bool((differs(asked, before) & inside).sum() * CYCLE > 1.0)


def differs(one: FloatArray, other: FloatArray) -> BoolArray:
    """Return whether two supply currents (n,), A, differ by more than readings of the same current can."""
    return np.asarray(np.abs(one - other) > OFF_SURELY + GAIN_ERROR * np.maximum(one, other))


def _is_upset(flown: Run, device: str, at: float) -> bool:
    """Return whether a flipped bit had an effect; unused or soon rewritten registers show none."""
    match device:
        case "pwm":
            obeyed = _obeyed(flown, at)
            return obeyed is None or obeyed > BLIND_GRACE
        case "monitor":
            house = flown["housekeeping"]
            time = house["time_ns"] * 1e-9
            after = (time >= max(at, LOOKED_FROM)) & (time < at + LOOKED)
            return not np.isfinite(house["coil_current"][after]).all()
        case _:
            time = flown["imu"]["time_ns"] * 1e-9
            came = int(((time >= at) & (time < at + LOOKED)).sum())
            return abs(came - round(LOOKED / CYCLE)) > FEW


def _is_frame_spoiled(kind: str, at: float, end: float) -> bool:
    """Return whether the fault affected a frame that was due."""
    due = np.arange(0.0, end, FRAME_PERIOD) + FRAME_EXPOSURE + FRAME_READOUT
    spoiled = due[(due >= at) & (due < end)]
    if kind == "torn":
        spoiled = spoiled[spoiled > FRAME_PERIOD]  # the first frame has no previous one
    if kind == "slow":
        # Triggers are lost, not frames that are already read out.
        triggers = np.arange(0.0, end, FRAME_PERIOD)
        spoiled = triggers[(triggers >= at) & (triggers < end)]
    if kind == "delayed":
        spoiled = spoiled[end - spoiled > FRAME_LATE]
    return len(spoiled) > 0


def _recovered(
    flown: Run, kind: FaultKind, at: float, end: float, reported: Sequence[tuple[float, str, str]]
) -> float | None:
    """Return the time (s) from a fault's end until the device's data are valid again.

    None if they never are.
    """
    house = flown["housekeeping"]
    found: float | None = 0.0
    match kind.device.partition("-")[0]:
        case "imu":
            found = _steady(flown["imu"]["time_ns"] * 1e-9, end, 0.06)
        case "pwm" | "bus":
            found = _obeyed(flown, end)
        case "monitor":
            finite, time = np.isfinite(house["coil_current"]), house["time_ns"] * 1e-9
            lost = time[~finite & (time >= end) & (time < end + LOOKED)]
            # The effects of a momentary fault begin only after the fault.
            found = _first(time[finite], end)
            if kind.momentary and len(lost):
                later = _first(time[finite], float(lost[-1]))
                found = None if later is None else float(lost[-1]) + later - end
            # This packet is sent four times a second, the housekeeping packet once.
            last = duration_of(flown) - CYCLE
            known = [t for t, name, _ in reported if name == "power-recovered" and t < last]
            back = _first(np.array(known), end)
            if back is not None:
                found = back if found is None or kind.momentary else min(found, back)
        case "camera":
            grown = np.flatnonzero(np.diff(house["frames"].astype(int)) > 0) + 1
            found = _first(house["time_ns"][grown] * 1e-9, end)
        case "coil" | "bridge":
            found = _first(np.array([time for time, name, _ in reported if name in COIL_JUDGED]), at)
        case "disk":
            found = _first(np.array([time for time, name, _ in reported if name == "log-recovered"]), end)
        case _:
            pass
    return found


def _first(times: FloatArray, end: float) -> float | None:
    later = times[times >= end - 1e-6]
    return float(later[0] - end) if len(later) else None


def _steady(times: FloatArray, end: float, gap: float, count: int = 8) -> float | None:
    """Return the time (s) from `end` until samples arrive without a gap."""
    later = times[times >= end - 1e-6]
    short = np.diff(later) < gap
    for first in range(len(short) - count):
        if short[first : first + count].all():
            return float(later[first] - end)
    return None


def _obeyed(flown: Run, end: float) -> float | None:
    """Return the time (s) from `end` until the coils carry the logged commands for half a second."""
    control, truth = flown["control"], flown["truth"]
    count = min(len(control), len(truth) - 1)
    # The true sample at the start of a cycle has the current of the previous command.
    reported, real = control["current_written"][:count], truth["current"][1 : count + 1]
    agrees = (np.abs(reported - real) < 8e-3).all(axis=1)
    time = control["time_ns"][:count] * 1e-9
    for first in np.flatnonzero(time >= end - 1e-6):
        if agrees[first : first + 20].all():
            return float(time[first] - end)
    return None


def _is_unmeasured(flown: Run) -> BoolArray:
    """Return, for each cycle, whether its newest measurement is older than the limit plus one cycle."""
    time_ns = flown["control"]["time_ns"]
    came_ns, sampled_ns = flown["imu"]["time_ns"], flown["imu"]["sample_time_ns"]
    count = np.searchsorted(came_ns, time_ns, side="right")
    newest = np.concatenate([[0], np.maximum.accumulate(sampled_ns)]) if len(sampled_ns) else np.zeros(1)
    return np.asarray((time_ns - newest[count]) * 1e-9 > BLIND_GRACE + CYCLE)


def _blind_current(flown: Run, also_unsteered: bool) -> float:
    """Return the largest current (A) while the age of the measurements exceeds the limit.

    In this time the estimate may be propagated, but no coil may be driven. `also_unsteered` adds cycles in
    which the loop has not controlled the body for as long as this limit, because the filter rejected the
    measurements.
    """
    off = flown["control"]["state"] == 0
    cycles = round(BLIND_GRACE / CYCLE)
    resting = np.array([off[max(0, place - cycles) : place + 1].all() for place in range(len(off))])
    blind = _is_unmeasured(flown) | (resting & also_unsteered)
    carried = _carried(flown)
    return float(np.max(carried[: len(blind)][blind[: len(carried)]], initial=0.0))


def _carried(flown: Run) -> FloatArray:
    """Return the largest true coil current (A) in each cycle, sampled at the start of the next cycle."""
    current: FloatArray = np.abs(flown["truth"]["current"]).max(axis=1)[1:]
    return current


def _reaction_right(
    flown: Run, kind: FaultKind, at: float, end: float, warned: Sequence[tuple[float, str]]
) -> bool | None:
    """Return whether the reaction in the table of events followed, or None if the table has none."""
    part = part_of(kind)
    # A reversed coil is not isolated: its sign is changed.
    expected = COIL_JUDGED if part == "coil" else {REACTION.get(part)}
    times = [time for time, name in warned if name in expected]
    control = flown["control"]
    time = control["time_ns"] * 1e-9
    driven = np.abs(control["current_written"]).max(axis=1) > DRIVEN
    right: bool | None = None
    match part:
        case "imu":
            lost = _is_unmeasured(flown) & (time >= at)
            if lost.any() and driven[(time >= at - 0.5) & (time <= at + 0.5)].any():
                right = bool(times) and not control["state"][lost].any()
        case "coil" | "bridge":
            # A coil that is soon isolated is driven for too short a time to count as exercised.
            if times or _is_exercised(flown, kind, at, end):
                right = bool(times)
        case "pwm" | "bus":
            if times and driven[(time >= times[0] - 1.0) & (time <= times[0])].any():
                # A chip that cannot be reached keeps its outputs. It must accept commands soon after it
                # returns.
                carried = _carried(flown)
                reported = (time >= times[0] - CYCLE) & (time <= end + BACK_WITHIN)
                zero = np.abs(control["current_written"]).max(axis=1) < ZERO
                zero[: len(carried)] |= carried[: len(zero)] < ZERO
                obeyed = _obeyed(flown, end) if part == "bus" or kind.kind in _OUT_OF_REACH else None
                right = bool(zero[reported].any()) or (obeyed is not None and obeyed <= BACK_WITHIN)
        case _:
            pass
    return right
