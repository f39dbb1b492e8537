"""Faults of the star camera."""

from __future__ import annotations

from dataclasses import replace

from sim_hal.faults.bench import Bench, Lift, held, no_lift
from sim_hal.faults.kinds import PERIOD, TURNS, Begin, FaultKind, Parameter, Parameters, delay, intermittently


def _showing(fault: str) -> Begin:
    def begin(bench: Bench, _: Parameters) -> Lift:
        camera = bench.hardware.camera
        if camera is None:
            return no_lift
        camera.fault = fault

        def lift() -> None:
            if camera.fault == fault:
                camera.fault = ""

        return lift

    return begin


def _slow(bench: Bench, given: Parameters) -> Lift:
    return held(bench.hardware.camera, "one_of", round(given["n"]), 1)


def _delayed(bench: Bench, given: Parameters) -> Lift:
    return held(bench.hardware.camera, "late_ns", round(given["delay"] * 1e9), 0)


CAMERA = (
    FaultKind("camera", "off", "ignores triggers, delivers no frame", _showing("off")),
    FaultKind("camera", "black", "frames without light", _showing("black")),
    FaultKind("camera", "saturated", "saturated frames", _showing("saturated")),
    FaultKind("camera", "blinded", "the Sun's stray light over the whole frame", _showing("blinded")),
    FaultKind("camera", "frozen", "the same frame repeatedly", _showing("frozen")),
    FaultKind("camera", "torn", "upper part of the previous frame, lower part of this one", _showing("torn")),
    FaultKind("camera", "garbage", "random pixels", _showing("garbage")),
    FaultKind("camera", "wrong", "rows in the opposite order", _showing("wrong")),
    FaultKind(
        "camera",
        "slow",
        "one trigger of n gives a frame",
        _slow,
        {"n": Parameter(3.0, 2.0, 1000.0, whole=True)},
    ),
    FaultKind("camera", "delayed", "frames arrive later, s", _delayed, {"delay": delay(3.0)}),
    FaultKind(
        "camera",
        "intermittent",
        "off intermittently",
        intermittently(_showing("off")),
        TURNS | {"period": replace(PERIOD, default=6.0)},
    ),
)
