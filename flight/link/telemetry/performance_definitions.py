"""Packets of the performance record: when cycles ran, and how long they took."""

from __future__ import annotations

from flight.link.telemetry.form import Field, Limits, Packet, counter

_LATENESS = Limits(fault=(0.0, 0.0125))
"""s, half a period of the demonstration's 40 Hz: a slot later than that is skipped."""
_EXECUTION = Limits(warning=(0.0, 0.0125), fault=(0.0, 0.025))

CYCLE_TIMING = Packet(
    "cycle_timing",
    0x150,
    "40 Hz, performance record",
    "When a control cycle ran and how long it took, on the machine's clock",
    (
        Field("cycle", "u8", "-", "slot of the control grid"),
        Field("lateness", "f8", "s", "start of the cycle after its slot", limits=_LATENESS),
        Field("execution", "f8", "s", "time spent in the cycle", limits=_EXECUTION),
    ),
    version=2,
)

RATE_GROUP = Packet(
    "rate_group",
    0x151,
    "1 Hz each, performance record",
    "One rate group of the executive since start",
    (
        Field("name", "S16", "-", "name of the group"),
        Field("period", "f8", "s", "its period"),
        counter("cycles", "slots that ran"),
        counter("slips", "slots that were skipped"),
        counter("overruns", "cycles longer than the period"),
        Field("mean", "f8", "s", "mean execution time"),
        Field("max", "f8", "s", "longest execution time"),
    ),
)

JOB_TIMING = Packet(
    "job_timing",
    0x152,
    "each job, performance record",
    "One job of a worker",
    (
        Field("name", "S16", "-", "name of the worker"),
        Field("execution", "f8", "s", "time spent in the job"),
        Field("outcome", "S16", "-", "done, failed, timed-out, died"),
    ),
)
