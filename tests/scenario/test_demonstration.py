"""Tests of the thesis's 700 s step demonstration with the documented command."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.app.cli import main
from flight.schema import reader as configuration
from ground import report
from ground.telemetry import Run, read_run
from tests.support.flights import CONFIG, demo_config, demo_world, fly
from tests.support.ideal_power import clairvoyant_power

ROOT = CONFIG.parents[1]
PIXELS_PER_RAD = 2904.0
LEAST_STREAK = 4.0
"""Streak length (px) above which a frame must give a rate; the estimator needs 3 px."""


def printed(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Run a `knightcube` command in this process, and return its output."""
    assert main([str(word) for word in arguments]) == 0
    return capsys.readouterr().out


@pytest.fixture(scope="module")
def demonstration(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("demonstration") / "run"
    words: list[str | Path] = [sys.executable, "-m", "flight", "run", CONFIG, "--out", folder]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return read_run(folder)


@pytest.fixture(scope="module")
def summary(demonstration: Run) -> dict[str, Any]:
    return report.summarise(demonstration)


@pytest.mark.slow
def test_it_is_flown_whole_with_every_cycle_and_no_alarm(demonstration: Run) -> None:
    run = demonstration
    assert len(run["control"]) == 28_000
    names = set(run["event"]["name"].tolist())
    assert names == {b"started", b"target", b"stopped"}
    for log in run.logs.values():
        assert log.intact


@pytest.mark.slow
def test_it_keeps_within_table_5_3_on_the_true_attitude(summary: dict[str, Any]) -> None:
    """Limits of Sease 2013, Table 5.3: 4.5 deg, 20 %, 8 s and 30 s, with a mean supply power below 0.10 W."""
    assert summary["attitude_source"] == "truth"
    steps, planner = summary["steps"], summary["planner"]
    assert planner["plans"] >= 140
    assert planner["accepted"] >= 135
    assert len(steps) == 7
    assert max(step["steady_state_deg"] for step in steps) < 4.5
    assert max(step["overshoot_percent"] for step in steps) < 20.0
    assert max(step["rise_s"] for step in steps[1:]) < 8.0
    assert max(step["settling_s"] for step in steps) < 30.0
    assert summary["power"]["supply_average_w"] < summary["power"]["bus_average_w"] < 0.10


@pytest.mark.slow
def test_it_is_as_good_as_the_physics_lets_it_be(summary: dict[str, Any]) -> None:
    """Errors are those of the true attitude with all noise.

    R I^2 is compared with the true plant's optimum.
    """
    steps = summary["steps"]
    assert max(step["steady_state_deg"] for step in steps) <= 0.05
    assert max(step["overshoot_percent"] for step in steps) <= 0.5
    assert max(step["rise_s"] for step in steps[1:]) <= 6.5
    assert max(step["settling_s"] for step in steps) <= 9.0
    floor = clairvoyant_power(demo_config(700.0), demo_world())
    assert summary["power"]["heat_average_w"] <= 1.05 * floor


@pytest.mark.slow
def test_no_coil_ever_carries_more_than_its_limit(demonstration: Run) -> None:
    run = demonstration
    assert np.abs(run["truth"]["current"]).max() <= 0.148
    assert np.abs(run["control"]["current_written"]).max() <= 0.148


@pytest.mark.slow
def test_the_estimate_is_as_good_as_it_says(demonstration: Run) -> None:
    """Check the fraction of angle and rate errors within 3 sigma, and rms / sigma, in 28,000 cycles."""
    run = demonstration
    control, truth = run["control"][200:], run["truth"][200:28_000]
    angle = 2.0 * np.arcsin(truth["quaternion"][:, 1])
    for error, sigma in (
        (control["angle"] - angle, control["angle_sigma"]),
        (control["rate"] - truth["rate"][:, 1], control["rate_sigma"]),
    ):
        assert np.mean(np.abs(error) < 3.0 * sigma) > 0.98
        assert 0.6 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.4


@pytest.mark.slow
def test_the_streak_rates_are_right_and_enter_the_estimate(demonstration: Run) -> None:
    """All 14 frames exposed in motion give a rate; six of the exposures begin at rest, with a step."""
    _assert_streaks_right(demonstration, 14)


def _assert_streaks_right(run: Run, moving: int) -> None:
    """Assert that each frame exposed in motion gives an accepted rate within 1 % of the truth, and its sigma.

    A chi-square per degree of freedom exceeds 2.1 (14 degrees of freedom) or 2.7 (6) with 1 % probability.
    """
    truth_time = run["truth"]["time_ns"]
    angle = 2.0 * np.arcsin(run["truth"]["quaternion"][:, 1])
    start = run["streak"]["exposure_start_ns"]
    mean = np.interp(start + 1e9, truth_time, angle) - np.interp(start, truth_time, angle)
    moves = np.abs(mean) * PIXELS_PER_RAD > LEAST_STREAK
    streaks, mean = run["streak"][moves], mean[moves]
    assert len(streaks) == moving
    assert (streaks["status"] == b"rate").all()
    assert streaks["accepted"].all()
    error = streaks["rate"][:, 1] - mean
    assert np.abs(error / mean).max() < 0.01
    deviations = error / np.sqrt(streaks["covariance"][:, 1])
    assert np.abs(deviations).max() < 4.0
    assert np.mean(deviations**2) < (2.1 if moving >= 14 else 2.7)


@pytest.mark.slow
def test_a_step_within_an_exposure_spoils_no_frame(tmp_path: Path) -> None:
    """The steps begin within exposures: the body is at rest for a part of them, and then accelerates."""
    config = demo_config(44.0)
    steps = tuple(
        configuration.replace(config.steps[0], at=at, q2=q2)
        for at, q2 in ((0.0, -0.3), (15.15, -0.2), (30.35, -0.3))
    )
    run = fly(configuration.replace(config, steps=steps), tmp_path)
    _assert_streaks_right(run, 6)


@pytest.mark.slow
def test_its_report_prints_the_figures_of_table_5_3_and_draws_seven_pictures(
    demonstration: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = printed(capsys, "report", demonstration.folder, "--figures", tmp_path / "figures")
    assert "steady-state error" in output
    assert len(list((tmp_path / "figures").glob("*.png"))) == 7


@pytest.mark.slow
def test_the_bus_gives_the_same_charge_at_its_higher_voltage(summary: dict[str, Any]) -> None:
    """The same current flows at 5 V (bus) and 3.4 V (coils). The bus monitor is read once a second."""
    power = summary["power"]
    assert power["bus_average_w"] == pytest.approx(power["supply_average_w"] * 5.0 / 3.4, rel=0.05)


@pytest.mark.slow
def test_the_readme_states_the_power_that_is_measured(summary: dict[str, Any]) -> None:
    """The README's mean powers (mW) at the coils, at the bus and as R I^2 must be the measured ones."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    row = re.search(
        r"^\| average power from the supply.*\| 0\.10 W \| (.+) mW; (.+) mW \|$", text, re.MULTILINE
    )
    heat = re.search(r"R I² of the mean current.*averages (\S+) mW", text)
    assert row is not None
    assert heat is not None
    power = summary["power"]
    measured = [1e3 * power[f"{name}_average_w"] for name in ("supply", "bus", "heat")]
    assert [float(figure) for figure in (*row.groups(), heat[1])] == pytest.approx(measured, rel=0.01)


def test_the_same_seed_gives_the_same_log_bit_for_bit_and_another_seed_does_not(tmp_path: Path) -> None:
    config = demo_config(4.0)
    logs = []
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        fly(config, tmp_path / name, seed=seed)
        logs.append([path.read_bytes() for path in sorted((tmp_path / name).glob("[ft]*.ccsds"))])
    assert logs[0] == logs[1]
    assert logs[0] != logs[2]


def test_the_json_report_is_one_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fly(demo_config(4.0, camera=False), tmp_path)
    output = printed(capsys, "report", tmp_path, "--json")
    assert json.loads(output)["run"]["config_name"] == "step-demo"
    assert not (tmp_path / "figures").exists()
