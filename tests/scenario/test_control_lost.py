"""Tests that the coil current is zero 0.1 s after a loss of control, and that control recovers.

Control is lost if readings stop, are incomplete, or contradict the estimate. Detumbling, which uses only the
magnetometer, is lost only if readings stop. The current of the simulated coil circuit is checked every
millisecond after the fault.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flight.schema import reader as configuration
from flight.schema.bodies import Step, TestbedConfig
from ground import report
from ground.report import steps as report_steps
from knightcube.astro.quaternion import from_rotation_vector, multiply
from sim_hal.emulators.serial_line import SOUND, LineFaults
from sim_hal.emulators.vn100_sensors import Vn100Sample
from tests.scenario.mode_flights import commanded, currents, released
from tests.support.flights import Rigged, demo_config, event_names, event_time, fly, thesis_config

SILENT_AT = 3.0
WITHIN = 0.1
CYCLE = 0.025
ZERO = 1e-3
"""Largest current (A) that is accepted as zero current."""

Break = Callable[[Rigged], None]


def silence(rigged: Rigged, seconds: float = 60.0) -> None:
    wire = rigged.lock.line.to_host
    rigged.at(SILENT_AT, lambda: setattr(wire, "faults", LineFaults(silent=True)))
    rigged.at(SILENT_AT + seconds, lambda: setattr(wire, "faults", SOUND))


def on_the_line(faults: LineFaults) -> Break:
    return lambda rigged: setattr(rigged.lock.line.to_host, "faults", faults)


def in_the_unit(alter: Callable[[Vn100Sample], Vn100Sample] | None) -> Break:
    return lambda rigged: setattr(rigged.lock.hardware.unit, "alter", alter)


def elsewhere(seen: Vn100Sample) -> Vn100Sample:
    """Return a reading that contradicts any estimate."""
    turn = from_rotation_vector(np.array([0.0, 0.2, 0.0]))
    return replace(seen, quaternion=multiply(turn, seen.quaternion), rate=seen.rate + 0.1)


def shifted(seen: Vn100Sample, by: float) -> Vn100Sample:
    """Return a reading with `by` added to the rate (rad/s) and to the field.

    The field is changed too, because control continues without a rate.
    """
    return replace(seen, rate=seen.rate + by, mag=seen.mag + by)


LOSSES: dict[str, tuple[Break, Break]] = {
    "silence": (on_the_line(LineFaults(silent=True)), on_the_line(SOUND)),
    "garbage": (on_the_line(LineFaults(garbage=True)), on_the_line(SOUND)),
    "damage": (on_the_line(LineFaults(cut_probability=1.0)), on_the_line(SOUND)),
    "not finite": (in_the_unit(lambda seen: shifted(seen, np.nan)), in_the_unit(None)),
    "out of range": (in_the_unit(lambda seen: shifted(seen, 1e3)), in_the_unit(None)),
    "refused": (in_the_unit(elsewhere), in_the_unit(None)),
}
"""Pairs of functions that start and end a loss of control, by the name of its cause."""


def slewing(duration: float) -> TestbedConfig:
    return commanded(duration, {"at": 1.0, "slew": -0.3}, initial="hold")


@pytest.mark.parametrize(
    ("configured", "rate", "losses"),
    [
        (lambda duration: demo_config(duration, camera=False), -0.1, tuple(LOSSES)),
        (thesis_config, -0.1, tuple(LOSSES)),
        (lambda duration: commanded(duration, initial="hold"), -0.1, tuple(LOSSES)),
        (slewing, -0.1, tuple(LOSSES)),
        # Detumbling continues with readings that the filter rejects, so the last cause is omitted.
        (lambda duration: commanded(duration, initial="detumble"), 0.45, tuple(LOSSES)[:-1]),
    ],
    ids=["demonstration", "thesis", "hold", "slew", "detumble"],
)
def test_no_coil_carries_current_a_tenth_of_a_second_after_the_last_usable_reading(
    tmp_path: Path, configured: Callable[[float], TestbedConfig], rate: float, losses: tuple[str, ...]
) -> None:
    # The worst cases are a loss just after a reading, and a loss just after the start of a detumbling window.
    begins = {name: 3.126 + 1.5 * place for place, name in enumerate(losses)}
    carried: dict[str, list[float]] = {name: [] for name in losses}

    def prepare(rigged: Rigged) -> None:
        circuit = rigged.lock.hardware.circuit
        for name, begin in begins.items():
            start, end = LOSSES[name]
            rigged.at(begin, lambda start=start: start(rigged))  # type: ignore[misc]  # a lambda with a default
            for k in range(400):
                look = carried[name].append
                rigged.at(begin + 1e-3 * k, lambda look=look: look(np.abs(circuit.currents()).max()))  # type: ignore[misc]
            rigged.at(begin + 0.4, lambda end=end: end(rigged))  # type: ignore[misc]

    run = fly(configured(begins[losses[-1]] + 1.0), tmp_path, prepare, section=released(0.2, rate))
    for name, seen in carried.items():
        driven = np.flatnonzero(np.array(seen) > ZERO)
        assert len(driven), f"{name}: nothing flowed that could have been let flow on"
        assert 1e-3 * (driven[-1] + 1) <= WITHIN, name
    after = begins[losses[-1]] + 0.4
    assert currents(run, after + WITHIN, after + 0.5).max() > ZERO, "it is flown again at once"
    assert "task-failed" not in event_names(run)


@pytest.mark.parametrize("initial", ["hold", "detumble"])
def test_a_silent_unit_is_reported_at_its_age_limit(tmp_path: Path, initial: str) -> None:
    run = fly(commanded(4.0, initial=initial), tmp_path, silence)
    assert event_time(run, "imu-silent") - SILENT_AT == pytest.approx(0.1, abs=2 * CYCLE)
    assert event_time(run, "control-lost") - SILENT_AT < 0.1 + CYCLE


def test_the_error_of_the_propagated_estimate_stays_within_four_sigma(
    tmp_path: Path,
) -> None:
    run = fly(demo_config(5.0, camera=False), tmp_path, silence)
    control = run["control"]
    time = control["time_ns"] * 1e-9
    carried = (time > SILENT_AT + 0.1) & np.isfinite(control["angle"])
    assert carried.sum() == pytest.approx((1.2 - 0.1) / CYCLE, abs=2), "for as long as estimation.coast says"
    truth = 2.0 * np.arcsin(run["truth"]["quaternion"][: len(control), 1])
    error = np.abs(control["angle"] - truth)[carried] / control["angle_sigma"][carried]
    assert error.max() < 4.0
    assert np.diff(control["angle_sigma"][carried]).min() >= 0.0, "it widens with every cycle"
    assert (control["state"][carried] == 0).all(), "and nothing steers by it"


def test_a_hold_that_is_declared_impossible_ends_at_once(tmp_path: Path) -> None:
    config = commanded(5.0, initial="hold", hold_error=1e-4, hold_patience=1.0)
    run = fly(config, tmp_path, section=released(0.2, -0.1))
    lost = event_time(run, "hold-impossible")
    assert currents(run, lost - 0.5, lost).max() > ZERO
    assert currents(run, lost + WITHIN, 5.0).max() == 0.0


def test_without_planner_and_readings_no_path_is_followed_to_its_end(tmp_path: Path) -> None:
    """A planned path is tracked only while readings arrive, even if no new plan replaces it."""
    run = fly(thesis_config(6.0), tmp_path, silence, planner_latency=0.9)
    assert run["plan"]["accepted"].tolist() == [1]
    assert currents(run, SILENT_AT - 0.5, SILENT_AT).max() > ZERO
    assert currents(run, SILENT_AT + WITHIN, 6.0).max() == 0.0


def test_without_planner_and_path_the_coils_stay_at_zero(tmp_path: Path) -> None:
    steps = ({"at": 1.0, "mode": "safe"}, {"at": 2.0, "slew": 0.0})
    config = commanded(8.0, *steps, slew_limit=3.0)
    run = fly(config, tmp_path, planner_latency=4.0)
    assert currents(run, -1.0, 4.9).max() == 0.0
    assert event_names(run)[:2] == ["started", "target"]
    assert "slew-late" in event_names(run)


def test_the_demonstration_is_completed_within_its_limits_after_five_seconds_without_the_unit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After five seconds without IMU readings, the demonstration is completed within its limits.

    Control is lost in the middle of a step, which is the worst case. The limits of Sease 2013, Table 5.3,
    apply to the next step. The steady state is the last 10 s of each step.
    """
    monkeypatch.setattr(report_steps, "STEADY_STATE_S", 10.0)
    config = demo_config(57.0, camera=False)
    steps = (Step(at=0.0, q2=-0.3), Step(at=35.0, q2=-0.2))
    run = fly(configuration.replace(config, steps=steps), tmp_path, lambda rigged: silence(rigged, 5.0))
    names = event_names(run)
    assert names.index("control-lost") < names.index("control-regained")
    regained = event_time(run, "control-regained")
    assert regained - (SILENT_AT + 5.0) < 0.2
    assert currents(run, regained + WITHIN, regained + 5.0).max() > 0.0
    first, second = report.summarise(run)["steps"]
    assert first["steady_state_deg"] < 4.5
    assert first["settling_s"] < 30.0
    assert second["steady_state_deg"] < 0.1
    assert second["overshoot_percent"] < 20.0
    assert second["rise_s"] < 8.0
