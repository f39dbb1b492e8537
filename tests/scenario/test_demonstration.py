"""Tests of the thesis's step demonstration, run by the documented command.

The demonstration lasts 700 s, and is mostly at rest: each of its seven steps settles within 9 s, and the
attitude is then held for 91 s. In the tests, the same steps begin every 30 s, with the same phase relative to
the camera frames. An error that appears only after 210 s, or after 30 s at one target, is found only by the
command `make demo`.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.app.cli import main
from flight.schema import reader as configuration
from ground import report
from ground.report import steps
from ground.report.signals import bus_power, coil_power
from ground.telemetry import Run, read_run
from tests.support.attitude_errors import assert_solved, star_errors, star_mismatch
from tests.support.coarse_pictures import draw_coarsely
from tests.support.flights import CONFIG, TEXT, demo_config, demo_world, fly
from tests.support.ideal_power import clairvoyant_power

ROOT = CONFIG.parents[1]
STARTS = tuple(step.at for step in demo_config(700.0).steps)
"""Start times (s) of the demonstration's steps."""
HELD = 30.0
"""Duration (s) of each step in these tests. In the last `RESTING` s of a step, the body is at rest."""
RESTING = 15.0
PIXELS_PER_RAD = 2904.0
LEAST_STREAK = 4.0
"""Streak length (px) above which a frame must give a rate; the estimator needs 3 px."""


def printed(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Run a `knightcube` command in this process, and return its output."""
    assert main([str(word) for word in arguments]) == 0
    return capsys.readouterr().out


@pytest.fixture(scope="module")
def demonstration(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return the flight of the shipped configuration with all its steps at intervals of `HELD` s."""
    folder = tmp_path_factory.mktemp("demonstration")
    text = re.sub(r"(?m)^duration: 700\.0", f"duration: {len(STARTS) * HELD}", TEXT)
    for index, start in enumerate(STARTS):
        text = text.replace(f"{{at: {start}, q2:", f"{{at: {index * HELD}, q2:")
    assert text.count("q2: ") == TEXT.count("q2: ")
    (folder / "quick.yaml").write_text(text, encoding="utf-8")
    assert main(["run", str(folder / "quick.yaml"), "--out", str(folder / "run")]) == 0
    return read_run(folder / "run")


@pytest.fixture(scope="module")
def summary(demonstration: Run) -> dict[str, Any]:
    """Return the report. The steady state of each step is its last `RESTING` s."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steps, "STEADY_STATE_S", RESTING)
        return report.summarise(demonstration)


@pytest.fixture(scope="module")
def power(demonstration: Run) -> dict[str, float]:
    """Return the mean powers (W) over 700 s.

    In a run of 700 s, each step lasts 70 s longer than in the tests. For the missing 70 s, the mean power at
    rest is used.
    """
    coils = coil_power(demonstration)
    assert coils is not None
    measured = {
        "supply": (coils.time, coils.supply),
        "heat": (coils.time, coils.heat),
        "bus": bus_power(demonstration),
    }
    means = {}
    for name, (time, watts) in measured.items():
        of_step = watts.reshape(len(STARTS), -1)
        resting = of_step[:, time.reshape(of_step.shape)[0] >= HELD - RESTING]
        added = (700.0 / len(STARTS) - HELD) * resting.mean(axis=1)
        means[name] = float(np.sum(HELD * of_step.mean(axis=1) + added) / 700.0)
    return means


@pytest.mark.slow
def test_the_demonstration_is_complete_with_every_cycle_and_no_alarm(demonstration: Run) -> None:
    run = demonstration
    assert len(run["control"]) == len(STARTS) * HELD * 40
    names = set(run["event"]["name"].tolist())
    assert names == {b"started", b"target", b"stopped"}
    for log in run.logs.values():
        assert log.intact


@pytest.mark.slow
def test_the_true_attitude_meets_the_limits_of_table_5_3(
    summary: dict[str, Any], power: dict[str, float]
) -> None:
    """The true attitude stays within the limits of Sease 2013, Table 5.3: 4.5 deg, 20 %, 8 s and 30 s.

    The mean supply power is below 0.10 W.
    """
    assert summary["attitude_source"] == "truth"
    found, planner = summary["steps"], summary["planner"]
    assert planner["plans"] >= len(STARTS) * HELD / 5.0, "a plan every 5 s"
    assert planner["accepted"] >= 135 / 140 * planner["plans"]
    assert len(found) == 7
    assert max(step["steady_state_deg"] for step in found) < 4.5
    assert max(step["overshoot_percent"] for step in found) < 20.0
    assert max(step["rise_s"] for step in found[1:]) < 8.0
    assert max(step["settling_s"] for step in found) < 30.0
    assert power["supply"] < power["bus"] < 0.10


@pytest.mark.slow
def test_the_demonstration_is_nearly_as_good_as_the_physics_permits(
    summary: dict[str, Any], power: dict[str, float]
) -> None:
    """The demonstration is nearly as good as the physics permits, with all simulated noise.

    The errors are angles from the target to the true attitude. R I^2 is compared with the optimum of the true
    plant.
    """
    found = summary["steps"]
    assert max(step["steady_state_deg"] for step in found) <= 0.05
    assert max(step["overshoot_percent"] for step in found) <= 0.5
    assert max(step["rise_s"] for step in found[1:]) <= 6.5
    assert max(step["settling_s"] for step in found) <= 9.0
    assert power["heat"] <= 1.05 * clairvoyant_power(demo_config(700.0), demo_world())


@pytest.mark.slow
def test_no_coil_ever_carries_more_than_its_limit(demonstration: Run) -> None:
    run = demonstration
    assert np.abs(run["truth"]["current"]).max() <= 0.148
    assert np.abs(run["control"]["current_written"]).max() <= 0.148


@pytest.mark.slow
def test_the_errors_of_the_estimate_agree_with_its_sigmas(demonstration: Run) -> None:
    """The errors of angle and rate agree with their sigmas in 8,200 cycles.

    The test checks the fraction of errors within 3 sigma, and the rms error relative to sigma.
    """
    run = demonstration
    control = run["control"][200:]
    truth = run["truth"][200 : len(run["control"])]
    angle = 2.0 * np.arcsin(truth["quaternion"][:, 1])
    for error, sigma in (
        (control["angle"] - angle, control["angle_sigma"]),
        (control["rate"] - truth["rate"][:, 1], control["rate_sigma"]),
    ):
        assert np.mean(np.abs(error) < 3.0 * sigma) > 0.98
        assert 0.6 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.4


@pytest.mark.slow
def test_the_streak_rates_are_right_and_enter_the_estimate(demonstration: Run) -> None:
    """All 14 frames that are exposed in motion give a correct rate, which the filter uses.

    Six of the exposures begin at rest and contain a step.
    """
    _assert_streaks_right(demonstration, 14)


def _assert_streaks_right(run: Run, moving: int) -> None:
    """Assert that each frame exposed in motion gives an accepted rate within 1 % and within its sigma.

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
def test_every_frame_gives_an_attitude_that_the_filter_accepts(demonstration: Run) -> None:
    """Every frame gives an attitude that the filter accepts.

    The first frame has streaks of 300 px, from the release at 0.1 rad/s.
    """
    stars = demonstration["stars"]
    assert len(stars) == len(STARTS) * HELD / 5.0
    assert_solved(demonstration)
    assert stars["tracked"].all()
    assert stars["accepted"].all()
    statuses = demonstration["streak"]["status"].tolist()
    assert statuses[0] == b"rate", "streaks first"
    assert statuses[-1] == b"too-short", "points at rest"


@pytest.mark.slow
def test_the_errors_of_the_star_attitudes_agree_with_their_covariances(demonstration: Run) -> None:
    """The mean normalised squared error of the star attitudes is below its upper bound.

    The mean normalised squared error about the suspension thread, the only rotation axis, is also above a
    lower bound.
    """
    error, covariance = star_errors(demonstration)
    about_thread = np.mean(error[:, 1] ** 2 / covariance[:, 1, 1])
    assert 0.05 < about_thread < 4.0
    assert star_mismatch(demonstration).mean() / 3.0 < 2.5
    resting = demonstration["streak"]["status"] == b"too-short"
    at_rest = np.degrees(np.linalg.norm(error[resting], axis=1)) * 3600.0
    assert len(at_rest) == len(error) - 14
    assert at_rest.max() < 10.0


@pytest.mark.slow
def test_a_step_within_an_exposure_spoils_no_frame(tmp_path: Path) -> None:
    """A frame remains usable if a step begins within its exposure.

    During the exposure, the body is first at rest and then accelerates.
    """
    config = demo_config(29.0)
    begun = tuple(
        configuration.replace(config.steps[0], at=at, q2=q2)
        for at, q2 in ((0.0, -0.3), (10.15, -0.2), (20.35, -0.3))
    )
    run = fly(configuration.replace(config, steps=begun), tmp_path)
    _assert_streaks_right(run, 6)


@pytest.mark.slow
def test_the_report_prints_the_figures_of_table_5_3_and_draws_seven_pictures(
    demonstration: Run,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    draw_coarsely(monkeypatch)
    output = printed(capsys, "report", demonstration.folder, "--figures", tmp_path / "figures")
    assert "steady-state error" in output
    assert len(list((tmp_path / "figures").glob("*.png"))) == 7


@pytest.mark.slow
def test_the_bus_gives_the_same_charge_at_its_higher_voltage(summary: dict[str, Any]) -> None:
    """The bus delivers the coils' charge at its higher voltage: 5 V instead of 3.4 V.

    The bus monitor is read once a second.
    """
    power = summary["power"]
    assert power["bus_average_w"] == pytest.approx(power["supply_average_w"] * 5.0 / 3.4, rel=0.05)


@pytest.mark.slow
def test_the_readme_states_the_power_that_is_measured(power: dict[str, float]) -> None:
    """The README states the measured mean powers (mW) at the coils, at the bus and as R I^2."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    row = re.search(
        r"^\| average power from the supply.*\| 0\.10 W \| (.+) mW; (.+) mW \|$", text, re.MULTILINE
    )
    heat = re.search(r"R I² of the mean current.*averages (\S+) mW", text)
    assert row is not None
    assert heat is not None
    measured = [1e3 * power[name] for name in ("supply", "bus", "heat")]
    assert [float(figure) for figure in (*row.groups(), heat[1])] == pytest.approx(measured, rel=0.01)


def test_the_same_seed_gives_the_same_log_bit_for_bit_and_another_seed_does_not(tmp_path: Path) -> None:
    config = demo_config(1.6)
    logs = []
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        run = fly(config, tmp_path / name, seed=seed)
        assert len(run["stars"]) == len(run["streak"]) == 1
        logs.append([path.read_bytes() for path in sorted((tmp_path / name).glob("[ft]*.ccsds"))])
    assert logs[0] == logs[1]
    assert logs[0] != logs[2]


def test_the_json_report_is_one_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fly(demo_config(1.0, camera=False), tmp_path)
    output = printed(capsys, "report", tmp_path, "--json")
    assert json.loads(output)["run"]["config_name"] == "step-demo"
    assert not (tmp_path / "figures").exists()
