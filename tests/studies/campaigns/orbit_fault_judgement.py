"""Evaluation of a run of campaign `orbit-faults` by its log and its true states."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flight.link.events import POINTING, Mode
from flight.link.telemetry.packets import to_text
from ground.campaigns.runner import Result
from ground.report.orbit import FINE, LOST, attitude_errors
from ground.report.signals import seconds
from ground.telemetry import Run
from knightcube.astro.arrays import BoolArray
from knightcube.astro.quaternion import attitude_matrix
from sim_hal.faults.catalogue import FaultKind
from tests.studies.campaigns.fault_judgement import (
    BLIND_GRACE,
    CYCLE,
    DRIVEN,
    FEW,
    LOOKED,
    OWN,
    differs,
    duration_of,
    events_of,
    own_events,
    part_of,
    warnings_in,
)

FIELD_GRACE = 8.2
"""Longest time (s) to zero current after the last valid field.

The detumbler predicts the field for `SILENT_PERIODS` periods (8 s) of the schedule in config/orbit.yaml.
"""
SIGMAS, FINE_AT_MOST = 5.0, np.radians(0.1)
"""Largest errors of an acceptable attitude, in claimed standard deviations and in rad."""
DIPOLE_PER_AMPERE = 0.648
"""Dipole moment per current (A m^2/A) of the coils of config/orbit.yaml."""
LAST = 12.0
"""Duration (s) of the last part of a flight, in which the body must meet the requirements of its mode
(`works`)."""
SET_UP = 0.53
"""Time (s) until the PWM chip is set up. Losses before this time are not counted."""
ACTS, RATE_OFF = 2e-3, 0.0175
"""Smallest current (A) of coils that control the body, and largest error (rad/s) of a usable rate estimate.

The rate is estimated from the magnetometer.
"""

ORBIT_OWN: Mapping[str, frozenset[str]] = {
    **OWN,
    "imu": OWN["imu"] | {"commands-doubted", "control-lost"},
    "magnetometer": frozenset({"imu-refused", "sun-unclear", "field-refused"}),
    "gps": frozenset({"gps-lost", "gps-refused"}),
    "strings": frozenset({"strings-lost", "sun-unclear"}),
    "wide": frozenset({"wide-lost", "wide-false"}),
    "clock": OWN["clock"] | {"clock-off"},
    "elements": frozenset({"gps-refused", "gps-lost"}),
}
"""Events that report a fault of a device in orbit, in addition to the events of the device's stream."""
_STREAMS = {"imu": ("imu", "field"), "magnetometer": ("field",), "gps": ("gps",), "camera": ("camera",)}
_AT_ZERO_COMMAND = ("bridge", "coil", "pwm", "bus")
"""Faults with which a coil may carry current although none is commanded."""


def judge(flown: Run, kind: FaultKind, mode: str, at: float, end: float) -> Result:
    """Return the evaluation of a fault from `at` to `end` s."""
    reported = events_of(flown)
    warned = warnings_in(reported, at, end, duration_of(flown))
    own = [(time, name) for time, name, text in warned if is_own(kind, name, text)]
    return {
        "at": at,
        "end": end,
        "exercised": bool(own) or is_exercised(flown, kind, mode, at, end),
        "told_s": own[0][0] - at if own else None,
        "event": own[0][1] if own else None,
        "reported": list(dict.fromkeys(name for _, name, _ in warned)),
        "works": works(flown, mode),
        "blind_current_a": blind_current(flown, kind, mode, at, end),
        "beyond_s": beyond(flown),
        "task_failed": any(name in {"task-failed", "service-failing"} for _, name, _ in reported),
        "log_intact": all(log.intact for log in flown.logs.values()),
    }


def is_own(kind: FaultKind, name: str, text: str) -> bool:
    """Return whether an event is specific to the faulty part."""
    part = part_of(kind)
    if name == "stream-poor":
        return text.startswith(tuple(f"{stream}:" for stream in _STREAMS.get(part, ("none",))))
    return name in ORBIT_OWN[part] or (part in OWN and name in own_events(kind))


def is_exercised(flown: Run, kind: FaultKind, mode: str, at: float, end: float) -> bool:
    """Return whether the faulty part was in use during its fault."""
    inside = _within(flown, "attitude", at, end)
    asked = np.abs(flown["attitude"]["dipole"][inside]) / DIPOLE_PER_AMPERE
    found = True
    match part_of(kind):
        case "coil" | "bridge":
            found = kind.kind.endswith("high") or _long(_driven(flown, kind, asked, inside))
        # a bit flip need not be reported; it counts as exercised only if the unit misses samples
        case part if kind.kind == "upset":
            came = int(_within(flown, "imu", at, at + LOOKED).sum())
            found = part == "imu" and round(LOOKED / CYCLE) - came > FEW
        case "monitor" if kind.kind == "delayed":
            found = _is_behind(flown, kind, inside)
        case "pwm" if kind.kind == "brown-out":
            found = at > SET_UP
        case "pwm" | "monitor":
            found = kind.kind in ALWAYS or _long((asked > 2 * DRIVEN).any(axis=1))
        case "camera":
            found = mode not in SPINS and end - at > 6.0
        case "planner" if kind.kind == "slow":
            found = False  # a slow plan takes 1.5 s of the permitted 8 s
        case "planner" | "vision":
            jobs = flown["job_timing"]
            when = seconds(jobs)
            mine = np.array([to_text(name) == kind.device for name in jobs["name"]], dtype=bool)
            found = bool((mine & (when > at + 0.3) & (when < end)).any())
        case "strings" if kind.kind == "dead":
            found = _is_string_lit(flown, at, end)
        case "strings" if kind.kind == "wrong":  # a fine attitude does not use the solar cells
            found = mode == "safe" or not _is_fine(flown, at, end)
        case "wide":  # upside-down pictures may look correct; an outage of 3 s affects one round of pictures
            found = kind.kind not in {"wrong", "intermittent"} and (
                kind.kind not in {"garbage", "blinded"} or _is_fine(flown, at, end)
            )
        case _:
            pass
    return found


ALWAYS = {"off", "nack", "slow", "intermittent", "garbage"}
"""Faults that affect a part whatever its commands are."""
SPINS = ("detumble", "safe")
"""Modes in which the body rotates too fast for the camera at first."""


def _is_fine(flown: Run, at: float, end: float) -> bool:
    """Return whether the attitude was fine all the time."""
    packets = flown["navigation"]
    inside = _within(flown, "navigation", at, end)
    return bool(inside.any() and (packets["knowledge"][inside] >= FINE).all())


def _driven(flown: Run, kind: FaultKind, asked: np.ndarray, inside: BoolArray) -> BoolArray:
    """Return at which samples a broken axis was commanded in the direction that its fault affects."""
    axis = "xyz".index(kind.device[-1])
    signed = flown["attitude"]["dipole"][inside][:, axis]
    wanted = {"a-low": signed > 0.0, "b-low": signed < 0.0}.get(kind.kind, np.ones(len(signed), dtype=bool))
    return np.asarray(wanted & (asked[:, axis] > 2 * DRIVEN))


def _is_behind(flown: Run, kind: FaultKind, inside: BoolArray) -> bool:
    """Return whether the commands (10 Hz) differed from the stuck reading for at least a second."""
    asked = np.abs(flown["attitude"]["dipole"]).sum(axis=1) / DIPOLE_PER_AMPERE
    behind = round(10.0 * (kind.parameters["delay"].default or 0.0))
    before = np.concatenate([np.full(behind, asked[0]), asked[:-behind]])
    return bool((differs(asked, before) & inside).sum() > 10)


def _long(driven: BoolArray) -> bool:
    """Return whether the commands of the attitude packets (10 Hz) drove the coil for 2.5 s in total."""
    return bool(driven.sum() > 25)


def _within(flown: Run, packet: str, at: float, end: float) -> BoolArray:
    times = seconds(flown[packet])
    return np.asarray((times >= at) & (times < max(end, at + 1.0)))


def _is_string_lit(flown: Run, at: float, end: float) -> bool:
    """Return whether the Sun was within 60 deg of the normal of the first solar cell string, on +x."""
    around = flown["orbit_truth"]
    if not len(around):
        return False
    truth = flown["truth"][_within(flown, "truth", at, end)]
    seen = attitude_matrix(truth["quaternion"].astype(float)) @ around["sun"][0]
    return bool((seen[:, 0] > 0.5).mean() > 0.3)


def works(flown: Run, mode: str) -> bool:
    """Return whether the body meets the requirements of its mode at the end of the flight.

    In detumbling the coils must act and the rate must be known, or the body must be slow. In other modes the
    attitude must be fine, and in pointing modes the coils must act.
    """
    truth, known = flown["truth"], flown["navigation"]["knowledge"]
    last = seconds(truth) > duration_of(flown) - LAST
    acts = bool((np.abs(truth["current"][last]) > ACTS).any())
    if mode == "safe":
        return acts
    now = Mode(int(flown["mode"]["mode"][-1])) if len(flown["mode"]) else Mode.DETUMBLE
    if mode == "detumble":
        slow = float(np.linalg.norm(truth["rate"][-1])) < RATE_OFF
        return slow if now is not Mode.DETUMBLE else acts and _rate_off(flown) < RATE_OFF
    fine = bool(known[-1] == FINE)
    if mode == "acquire":
        return fine
    return fine and acts and now in POINTING


def _rate_off(flown: Run) -> float:
    """Return the median error (rad/s) of the rate from the magnetometer in the last seconds."""
    spin, truth = flown["spin"], flown["truth"]
    spin = spin[(seconds(spin) > duration_of(flown) - LAST) & (spin["known"] == 1)]
    if not len(spin):
        return float("inf")
    place = np.minimum(np.searchsorted(truth["time_ns"], spin["time_ns"]), len(truth) - 1)
    return float(np.median(np.linalg.norm(spin["rate"] - truth["rate"][place], axis=1)))


def blind_current(flown: Run, kind: FaultKind, mode: str, at: float, end: float) -> float:
    """Return the largest current (A) of a coil that was driven without valid data, sensor by sensor."""
    if part_of(kind) in _AT_ZERO_COMMAND:
        return 0.0
    truth = flown["truth"]
    times, current = seconds(truth), np.abs(truth["current"]).max(axis=1)
    came, sampled = seconds(flown["imu"]), flown["imu"]["sample_time_ns"] * 1e-9
    newest = np.concatenate([[0.0], np.maximum.accumulate(sampled)])
    heard = newest[np.searchsorted(came, times, side="right")]
    blind = times - heard > BLIND_GRACE + 2 * CYCLE
    if mode in {"detumble", "safe"} and kind.name in {"magnetometer: stuck", "magnetometer: saturated"}:
        blind |= (times > at + FIELD_GRACE) & (times < end)
    known = flown["navigation"]
    if mode not in {"detumble", "safe"} and len(known):
        place = np.searchsorted(seconds(known), times, side="right") - 1
        lost = known["knowledge"] == LOST
        both = lost & np.roll(lost, 1)
        blind |= (place > 0) & both[np.maximum(place, 0)] & _points(flown, times)
    return float(np.max(current[blind], initial=0.0))


def _points(flown: Run, times: np.ndarray) -> BoolArray:
    modes = flown["mode"]
    place = np.searchsorted(seconds(modes), times, side="right") - 1
    now = modes["mode"][np.maximum(place, 0)]
    return np.isin(now, [int(mode) for mode in POINTING])


def beyond(flown: Run) -> float:
    """Return how long (s) the coils were driven with a wrong attitude estimate."""
    errors = attitude_errors(flown)
    if not len(errors.times):
        return 0.0
    bound = np.maximum(SIGMAS * errors.sigma, FINE_AT_MOST)
    off = (np.abs(errors.error) > bound).any(axis=1)
    truth = flown["truth"]
    place = np.minimum(np.searchsorted(seconds(truth), errors.times), len(truth) - 1)
    driven = np.abs(truth["current"][place]).max(axis=1) > DRIVEN
    return float((off & driven & _points(flown, errors.times)).sum() * 0.1)
