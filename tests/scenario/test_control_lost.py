"""From the loss of control the coils are at zero within a tenth of a second; the rest follows by itself.

Control is lost when the estimate is older than `estimation.coast`: until then the model carries it, with a
covariance that says how well. In detumble there is no model, and the age limit of the unit itself holds.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight import config as configuration
from flight import report
from flight.settings import Config, Step
from flight.telemetry.reader import Run
from sim_hal.emulators.serial_line import SOUND, LineFaults
from tests.scenario.flights import Rigged, demo_config, event_names, fly, thesis_config
from tests.scenario.test_modes import commanded, currents, released

SILENT_AT = 3.0
WITHIN = 0.1
CYCLE = 0.025


def told(run: Run, name: str) -> float:
    """Return the mission time, s, of the first event of a name."""
    return float(run["event"]["time_ns"][event_names(run).index(name)]) * 1e-9


def silence(rigged: Rigged, seconds: float = 60.0) -> None:
    wire = rigged.lock.line.to_host
    rigged.at(SILENT_AT, lambda: setattr(wire, "faults", LineFaults(silent=True)))
    rigged.at(SILENT_AT + seconds, lambda: setattr(wire, "faults", SOUND))


@pytest.mark.parametrize(
    ("config", "declared_after"),
    [
        (demo_config(8.0, camera=False), 1.2),
        (thesis_config(8.0), 0.1),
        (commanded(8.0, initial="hold"), 1.2),
        (commanded(8.0, initial="detumble"), 0.1),
    ],
    ids=["demonstration", "thesis", "hold", "detumble"],
)
def test_a_silent_unit_is_told_at_its_age_limit_and_the_coils_are_off_a_tenth_of_a_second_after_the_loss(
    tmp_path: Path, config: Config, declared_after: float
) -> None:
    speed = 0.4 if config.modes.initial == "detumble" else -0.1
    run = fly(config, tmp_path, silence, section=released(0.2, speed))
    assert currents(run, SILENT_AT - 0.5, SILENT_AT).max() > 0.0
    assert told(run, "imu-silent") - SILENT_AT == pytest.approx(0.1, abs=2 * CYCLE)
    lost = told(run, "control-lost")
    assert lost - SILENT_AT == pytest.approx(declared_after, abs=3 * CYCLE)
    assert currents(run, lost + WITHIN, 8.0).max() == 0.0


def test_while_the_model_steers_the_true_error_stays_within_what_the_covariance_says(tmp_path: Path) -> None:
    run = fly(demo_config(8.0, camera=False), tmp_path, silence)
    control = run["control"]
    time = control["time_ns"] * 1e-9
    carried = (time > SILENT_AT + 0.1) & (time < told(run, "control-lost"))
    truth = 2.0 * np.arcsin(run["truth"]["quaternion"][: len(control), 1])
    error = np.abs(control["angle"] - truth)[carried] / control["angle_sigma"][carried]
    assert carried.sum() > 30
    assert error.max() < 4.0
    assert np.diff(control["angle_sigma"][carried]).min() >= 0.0, "it widens with every cycle"


def test_with_the_planner_gone_and_no_path_the_coils_stay_at_zero(tmp_path: Path) -> None:
    steps = ({"at": 1.0, "mode": "safe"}, {"at": 2.0, "slew": 0.0})
    config = commanded(8.0, *steps, slew_limit=3.0)
    run = fly(config, tmp_path, planner_latency=4.0)
    assert currents(run, -1.0, 4.9).max() == 0.0
    assert event_names(run)[:2] == ["started", "target"]
    assert "slew-late" in event_names(run)


def test_the_demonstration_is_completed_within_its_limits_after_five_seconds_without_the_unit(
    tmp_path: Path,
) -> None:
    """In the middle of a step, where it costs most; Sease 2013, Table 5.3, for the step after it."""
    config = demo_config(130.0, camera=False)
    steps = (Step(at=0.0, q2=-0.3), Step(at=65.0, q2=-0.2))
    run = fly(configuration.replace(config, steps=steps), tmp_path, lambda rigged: silence(rigged, 5.0))
    names = event_names(run)
    assert names.index("control-lost") < names.index("control-regained")
    regained = told(run, "control-regained")
    assert regained - (SILENT_AT + 5.0) < 0.2
    assert currents(run, regained + WITHIN, regained + 5.0).max() > 0.0
    first, second = report.summarise(run)["steps"]
    assert first["steady_state_deg"] < 4.5
    assert first["settling_s"] < 30.0
    assert second["steady_state_deg"] < 0.1
    assert second["overshoot_percent"] < 20.0
    assert second["rise_s"] < 8.0
