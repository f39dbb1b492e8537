"""Table of the event and the reaction that each fault must cause, used by campaign `faults`.

A fault counts as reported only by a specific event: a stuck coil also causes a tumbling event, but that event
does not name the failed part. Where the table of events has a reaction, the reaction must follow.
"""

from __future__ import annotations

from collections.abc import Mapping

from sim_hal.faults.catalogue import FaultKind

_STARS = {"stars-refused", "streak-refused", "vision-failed"}

OWN: Mapping[str, frozenset[str]] = {
    "imu": frozenset(
        {"imu-silent", "imu-corrupt", "imu-implausible", "imu-line-lost", "imu-refused", "imu-unusable"}
        | {"gyro-lost"}
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
"""Events by which a broken coil is isolated, or a reversed one used with its sign changed."""

OWN_OF_KIND: dict[str, frozenset[str]] = {
    # The packets are valid, but too few or too old for control, so only the event of the stream is reported.
    "imu: slow": OWN["imu"] | {"stream-poor"},
    "imu: delayed": OWN["imu"] | {"stream-poor"},
    "imu: intermittent": OWN["imu"] | {"stream-poor"},
    "imu: cut": OWN["imu"] | {"stream-poor"},
}
"""Events that report a fault, for the kinds of fault that differ from the entries of `OWN`."""

REACTION: Mapping[str, str] = {
    "imu": "control-lost",
    "pwm": "coil-fault",
    "bus": "coil-fault",
    "coil": "coil-broken",
    "bridge": "coil-broken",
}
"""Event whose reaction in the table of events (coils off, or isolation) must follow."""


def part_of(kind: FaultKind) -> str:
    """Return the device name that the table uses for a fault; the coils of all axes share one row."""
    return kind.device.partition("-")[0]


def own_events(kind: FaultKind) -> frozenset[str]:
    """Return the names of the events that report a fault."""
    return OWN_OF_KIND.get(kind.name, OWN[part_of(kind)])
