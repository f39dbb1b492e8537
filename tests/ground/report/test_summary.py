"""Tests that the summary reports the results of a run, and names results that are unknown."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from flight.link import events
from flight.link.events import Mode
from flight.link.telemetry.definitions import CONTROL, STREAK, TRUTH
from flight.link.telemetry.log import FlightLog
from flight.link.telemetry.packets import Packer
from flight.loop.facts import FACTS, StreamState
from flight.schema import reader
from ground.report import format_report, summarise
from ground.report.signals import coil_power, covariance_matrices, mean_rates
from ground.telemetry import Run, read_run, scan
from tests.ground.report.synthetic import (
    CURRENT,
    DAMPING,
    RATE_BIAS,
    RESISTANCE,
    STAR_ERROR,
    STREAK_ERROR,
    TARGETS,
    VOLTAGE,
    Recipe,
    make_run,
)
from tests.manual_clock import ManualClock
from tests.support.packed_run import packed_run

OVERSHOOT = 100.0 * math.exp(-math.pi * DAMPING / math.sqrt(1.0 - DAMPING**2))


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return read_run(make_run(tmp_path_factory.mktemp("full"), Recipe(rate_hz=10.0)))


def short(tmp_path: Path, **changes: object) -> Run:
    plain: dict[str, object] = {"duration": 250.0, "rate_hz": 10.0, **changes}
    return read_run(make_run(tmp_path / "run", Recipe(**plain)))  # type: ignore[arg-type]  # built by name


def test_every_step_of_a_full_run_is_judged_on_the_truth(full: Run) -> None:
    summary = summarise(full)
    assert summary["attitude_source"] == "truth"
    assert [step["target_q2"] for step in summary["steps"]] == list(TARGETS)
    for step in summary["steps"]:
        assert step["complete"]
        assert step["overshoot_percent"] == pytest.approx(OVERSHOOT, abs=0.05)
        assert step["steady_state_deg"] == pytest.approx(0.0, abs=1e-3)
    assert [step["rise_judged"] for step in summary["steps"]] == [False] + 6 * [True]
    assert summary["steps"][0]["from_q2"] == pytest.approx(0.2)
    assert summary["notes"] == []
    assert not summary["run"]["cut_short"]


def test_the_worst_value_of_each_result_is_stated_beside_that_of_the_thesis(full: Run) -> None:
    rows = {row["quantity"]: row for row in summarise(full)["thesis"]}
    limits = {name: (row["limit"], row["unit"]) for name, row in rows.items()}
    assert limits == {
        "steady-state error": (4.5, "deg"),
        "overshoot": (20.0, "%"),
        "rise time": (8.0, "s"),
        "settling time": (30.0, "s"),
        "average supply power at the coils": (0.10, "W"),
        "average supply power at the bus": (0.10, "W"),
        "largest current": (0.148, "A"),
    }
    assert {row["verdict"] for row in rows.values()} == {"pass"}
    assert rows["overshoot"]["worst"] == pytest.approx(OVERSHOOT, abs=0.05)


def test_supply_power_and_heat_are_means_from_the_true_energies(full: Run) -> None:
    """Mean powers and energies result from a coil current of 0.1 A for a tenth of the time."""
    power = summarise(full)["power"]
    assert power["source"] == "truth"
    assert power["heat_average_w"] == pytest.approx(0.1 * RESISTANCE * CURRENT**2, rel=1e-9)
    assert power["heat_j"] == pytest.approx(70.0 * RESISTANCE * CURRENT**2, rel=1e-9)
    assert power["supply_average_w"] == pytest.approx(0.1 * VOLTAGE * CURRENT, rel=1e-9)
    assert power["supply_peak_w"] == pytest.approx(VOLTAGE * CURRENT, rel=1e-6)
    assert power["supply_j"] == pytest.approx(70.0 * VOLTAGE * CURRENT, rel=1e-9)
    assert power["peak_current_a"] == CURRENT


def test_without_truth_estimate_and_written_currents_are_judged(tmp_path: Path) -> None:
    run = short(tmp_path, truth=False, duration=300.0, planned=300.0)
    summary = summarise(run)
    assert summary["attitude_source"] == "estimate"
    assert summary["power"]["source"] == "written"
    assert summary["power"]["heat_average_w"] == pytest.approx(0.1 * RESISTANCE * CURRENT**2, rel=1e-9)
    assert summary["power"]["supply_average_w"] == pytest.approx(0.1 * VOLTAGE * CURRENT, rel=1e-9)
    assert summary["power"]["peak_current_actual_a"] is None
    assert summary["estimate"] is None
    assert summary["streaks"]["rms_error"] is None
    assert summary["steps"][1]["overshoot_percent"] == pytest.approx(OVERSHOOT, abs=0.05)
    assert "no truth log: judged on the estimate" in summary["notes"]


def test_a_truncated_run_is_judged_on_its_complete_steps_and_reported_as_truncated(tmp_path: Path) -> None:
    summary = summarise(short(tmp_path))
    assert [step["complete"] for step in summary["steps"]] == [True, True, False]
    unfinished = summary["steps"][2]
    assert [
        unfinished[key] for key in ("steady_state_deg", "overshoot_percent", "rise_s", "settling_s")
    ] == 4 * [None]
    assert summary["run"]["cut_short"]
    assert "cut short: 250.0 s of 700.0 s" in summary["notes"]
    assert "step 2: the log does not cover the whole step, not judged" in summary["notes"]
    assert {row["verdict"] for row in summary["thesis"]} == {"pass"}


def test_the_flight_log_decides_how_long_a_run_lasted(tmp_path: Path) -> None:
    """The truth log of a simulation may be longer than a flight log that lost its last packets."""
    short(tmp_path, planned=250.0)
    log = tmp_path / "run" / "flight-0001.ccsds"
    log.write_bytes(log.read_bytes()[: log.stat().st_size * 3 // 5])
    summary = summarise(read_run(tmp_path / "run"))
    lasted = summary["run"]["duration_s"]
    assert 100.0 < lasted < 200.0
    assert summary["run"]["cut_short"]
    (note,) = [note for note in summary["notes"] if note.startswith("the flight log ends ")]
    assert float(note.split()[4]) == pytest.approx(250.0 - lasted, abs=0.2)
    assert note.endswith("the truth log: its last packets are lost")
    run = read_run(tmp_path / "run")
    rows = run.flight.packets["run"].copy()
    rows["realtime"] = 1
    run.flight.packets["run"] = rows
    assert any(
        note.endswith("the flight process died, or its last packets are lost")
        for note in summarise(run)["notes"]
    )


def test_a_satellite_stopped_before_its_first_cycle_is_not_judged_as_a_testbed(tmp_path: Path) -> None:
    text = (Path(reader.__file__).parent / "configurations" / "orbit.yaml").read_text(encoding="utf-8")
    (tmp_path / "config.yaml").write_text(text, encoding="utf-8")
    event = {"code": events.STOPPED.code, "name": "stopped", "severity": 0, "text": "by SIGINT"}
    summary = summarise(packed_run(tmp_path, run=[(0.0, {"duration": 3000.0})], event=[(-0.958, event)]))
    assert summary["run"]["duration_s"] == 0.0
    assert summary["thesis"] == []
    assert [row["verdict"] for row in summary["requirements"]] == ["unknown"]
    assert "stopped before the first control cycle" in summary["notes"]
    assert not any("target packets" in note for note in summary["notes"])


def test_a_shorter_run_that_was_meant_to_be_short_is_complete(tmp_path: Path) -> None:
    summary = summarise(short(tmp_path, planned=250.0))
    assert [step["complete"] for step in summary["steps"]] == [True, True, True]
    assert not summary["run"]["cut_short"]


def test_a_run_without_targets_has_no_steps_and_unknown_verdicts(tmp_path: Path) -> None:
    summary = summarise(short(tmp_path, commands=False))
    assert summary["steps"] == []
    verdicts = {row["quantity"]: row["verdict"] for row in summary["thesis"]}
    assert verdicts["rise time"] == verdicts["overshoot"] == "unknown"
    assert verdicts["average supply power at the coils"] == "pass"
    assert "no target packets: no attitude step can be judged" in summary["notes"]


def test_a_step_of_no_size_is_distinguished_from_one_never_made(tmp_path: Path) -> None:
    summary = summarise(short(tmp_path, duration=300.0, planned=300.0, targets=(-0.3, -0.3, -0.2)))
    assert summary["steps"][1]["complete"]
    assert summary["steps"][1]["rise_s"] is None
    assert "step 1: the target equals the previous one, only the steady state is judged" in summary["notes"]
    verdicts = {row["quantity"]: row["verdict"] for row in summary["thesis"]}
    assert verdicts["rise time"] == "pass"


def test_an_interrupted_step_is_not_judged(tmp_path: Path) -> None:
    """A step that ends after 3 s is not judged, because 3 s are too few to reach 90 % of the step."""
    summary = summarise(short(tmp_path, duration=6.0, planned=6.0, hold=3.0))
    assert not any(step["complete"] for step in summary["steps"])
    assert "step 1: interrupted after 3.0 s, not judged" in summary["notes"]
    verdicts = {row["quantity"]: row["verdict"] for row in summary["thesis"]}
    assert {verdicts[name] for name in ("overshoot", "rise time", "settling time")} == {"unknown"}


def test_frames_without_rate_and_attitude_are_listed_with_the_reason(full: Run, tmp_path: Path) -> None:
    log, packer = FlightLog(tmp_path, "flight", clock=ManualClock()), Packer()
    nothing = {"rate": (math.nan,) * 3, "covariance": (math.nan,) * 6, "exposure": 0.2, "residual": math.nan}
    counts = {"streaks": 0, "used": 0, "length": math.nan, "accepted": False}
    log.write(
        packer.pack(
            STREAK, 5, sequence=7, exposure_start_ns=4_500_000_000, status="too-few", **nothing, **counts
        )
    )
    log.close()
    summary = summarise(read_run(tmp_path))
    assert summary["failed_frames"] == [
        {"sequence": 7, "exposed_s": 4.5, "streaks": "too-few", "stars": None}
    ]
    assert "Frames without rate or attitude: 1" in format_report(summary)
    assert summarise(full)["failed_frames"] == []


def test_a_step_never_settled_is_a_miss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step that has not settled after 40 s misses the requirement.

    The tested response is too slow to reach 90 % of the step in 40 s.
    """
    monkeypatch.setattr("tests.ground.report.synthetic.FREQUENCY", 0.02)
    summary = summarise(short(tmp_path, duration=80.0, planned=80.0, hold=40.0))
    assert summary["steps"][1]["settling_s"] is None
    assert "step 1: never settled" in summary["notes"]
    verdicts = {row["quantity"]: row["verdict"] for row in summary["thesis"]}
    assert verdicts["settling time"] == "miss"


def test_without_a_monitor_the_power_at_the_bus_is_unknown(tmp_path: Path) -> None:
    summary = summarise(short(tmp_path, bus_power=None))
    assert summary["power"]["bus_average_w"] is None
    (bus,) = [row for row in summary["thesis"] if row["quantity"] == "average supply power at the bus"]
    assert (bus["worst"], bus["verdict"]) == (None, "unknown")


def test_the_largest_true_current_is_that_of_any_of_six_coils() -> None:
    truth = [(0.0, {"current": [0.01, -0.02, 0.0]})]
    coils = [(0.0, {"current": [0.01, -0.02, 0.0, 0.03, -0.05, math.nan]})]
    started = [(0.0, {"name": "started", "code": 1})]
    power = summarise(packed_run(event=started, truth=truth, true_coil_currents=coils))["power"]
    assert power["peak_current_actual_a"] == pytest.approx(0.05)
    power = summarise(packed_run(event=started, truth=truth))["power"]
    assert power["peak_current_actual_a"] == pytest.approx(0.02)
    assert summarise(packed_run(event=started))["power"]["peak_current_actual_a"] is None


def test_the_supply_power_is_judged_by_the_thesis_whatever_r_i_squared_is(tmp_path: Path) -> None:
    """The requirement of 0.10 W applies to the supply power, not to R I^2.

    The powers are 0.11 W at the coils and 0.16 W at the bus, and R I^2 is only 0.01 W.
    """
    log, packer = FlightLog(tmp_path, "truth", clock=ManualClock()), Packer()
    for i in range(100):
        log.write(
            packer.pack(TRUTH, i * 25_000_000, quaternion=(0, 0, 0, 1), rate=(0, 0, 0), current=(0.2, 0, 0),
                        energy=0.01 * 0.025 * i, supply_energy=0.11 * 0.025 * i)
        )  # fmt: skip
    log.close()
    make_run(tmp_path, Recipe(duration=2.0, truth=False, bus_power=0.16))
    summary = summarise(read_run(tmp_path))
    rows = {row["quantity"]: row for row in summary["thesis"]}
    for place, average in (("coils", 0.11), ("bus", 0.16)):
        row = rows[f"average supply power at the {place}"]
        assert (row["verdict"], row["limit"]) == ("miss", 0.10)
        assert row["worst"] == pytest.approx(average)
    assert summary["power"]["heat_average_w"] == pytest.approx(0.01)


def test_a_run_without_its_identity_is_still_reported(tmp_path: Path) -> None:
    run = short(tmp_path, identity=False, truth=False)
    assert coil_power(run) is None
    summary = summarise(run)
    assert "no run packet: the configuration of this run is not known" in summary["notes"]
    assert any(note.startswith("power not known") for note in summary["notes"])
    assert [step["complete"] for step in summary["steps"]] == [True, True, False]
    assert format_report(summary)


def test_loop_planner_events_and_logs_are_counted(full: Run) -> None:
    summary = summarise(full)
    assert [group["name"] for group in summary["rate_groups"]] == ["control", "housekeeping"]
    assert summary["rate_groups"][0]["cycles"] == 7001
    assert summary["rate_groups"][0]["slips"] == 3
    assert summary["cycles"]["lateness_s"]["max"] == pytest.approx(6e-5)
    assert summary["cycles"]["execution_s"]["p50"] == pytest.approx(5e-4)
    assert summary["cycles"]["skipped"] == 0
    (job,) = summary["jobs"]
    assert (job["name"], job["count"], job["outcomes"]) == ("planner", 3, {"done": 3})
    assert job["execution_s"]["p50"] == pytest.approx(0.012)
    planner = summary["planner"]
    assert [planner[key] for key in ("plans", "accepted", "refused", "stretched")] == [7, 6, 1, 1]
    assert planner["refusals"] == {"infeasible": 1}
    assert planner["longest_horizon_s"] == 13.0
    (event,) = summary["events"]
    assert (event["name"], event["count"], event["first_s"]) == ("target", 14, 0.0)
    assert [log["log"] for log in summary["logs"]] == ["flight", "truth", "performance"]
    assert all(log["skipped_bytes"] == log["missing_packets"] == 0 for log in summary["logs"])


def test_a_control_packet_that_is_missing_from_the_log_does_not_count_as_a_skipped_slot(
    full: Run, tmp_path: Path
) -> None:
    raw = (full.folder / "flight-0001.ccsds").read_bytes()
    length = 155
    third = [m for m in range(len(raw)) if raw[m : m + 2] == b"\x09\x11"][2]
    (tmp_path / "flight-0001.ccsds").write_bytes(raw[:third] + raw[third + length :])
    summary = summarise(read_run(tmp_path))
    assert (summary["cycles"]["missing"], summary["cycles"]["skipped"]) == (1, 0)
    (note,) = [note for note in summary["notes"] if "damaged" in note]
    assert note.startswith("the flight log is damaged: 1 packets are missing, 4 bytes belong to no packet; ")
    assert summary["logs"][0]["missing_packets"] == 1


@pytest.mark.parametrize(
    ("lost", "slots", "expected"),
    [(3, 4, (3, 1)), (16_390, 16_390, (16_390, 0)), (16_390, 16_395, (16_390, 5))],
)
def test_missing_cycles_and_skipped_slots_in_one_gap_are_distinguished(
    lost: int, slots: int, expected: tuple[int, int]
) -> None:
    """Packets of `slots` slots are absent: `lost` packets were lost, and the loop skipped the other slots."""
    packer, zero = Packer(), {f.name: [0] * f.count if f.count > 1 else 0 for f in CONTROL.fields}
    packets = [packer.pack(CONTROL, k, {**zero, "cycle": k}) for k in range(lost + 1)]
    packets.append(packer.pack(CONTROL, lost + 1, {**zero, "cycle": slots + 1}))
    log = scan(packets[0] + packets[-1])
    cycles = summarise(Run(Path("run"), log, scan(b""), scan(b"")))["cycles"]
    assert (cycles["missing"], cycles["skipped"]) == expected


def test_estimate_and_streaks_are_held_against_the_truth(full: Run) -> None:
    """The estimate and each streak rate have errors of exactly one sigma, so the normalised error is one."""
    summary = summarise(full)
    assert summary["estimate"]["rate_rms_rad_s"] == pytest.approx(RATE_BIAS, rel=1e-6)
    assert summary["estimate"]["rate_normalised"] == pytest.approx(1.0, rel=1e-6)
    assert summary["estimate"]["angle_rms_rad"] == pytest.approx(0.0, abs=1e-12)
    streaks = summary["streaks"]
    assert streaks["frames"] == streaks["rates"] == streaks["accepted"] == streaks["compared"] == 140
    assert streaks["rms_error"] == pytest.approx([0.0, STREAK_ERROR, 0.0], rel=1e-6, abs=1e-9)
    assert streaks["normalised"] == pytest.approx(1.0, rel=1e-4)
    stars = summary["stars"]
    assert stars["frames"] == stars["solved"] == stars["tracked"] == stars["accepted"] == 140
    assert stars["compared"] >= 139
    assert stars["rms_error"] == pytest.approx([0.0, STAR_ERROR, 0.0], rel=1e-3, abs=1e-9)
    assert stars["normalised"] == pytest.approx(1.0, rel=1e-3)


def test_the_mean_rate_over_an_exposure_is_the_turn_over_its_time() -> None:
    """The mean of a linearly increasing rate is the rate at mid-exposure."""
    packer = Packer()
    raw = b"".join(
        packer.pack(TRUTH, i * 25_000_000, quaternion=(0, 0, 0, 1), rate=(0, 0.01 * 0.025 * i, 0),
                    current=(0, 0, 0), energy=0, supply_energy=0)
        for i in range(401)
    )  # fmt: skip
    truth = scan(raw).packets["truth"]
    mean = mean_rates(truth, np.array([1.0, 2.013, 9.5]), np.array([2.0, 3.0, 10.5]))
    np.testing.assert_allclose(mean[:2, 1], [0.015, 0.01 * 0.5 * (2.013 + 3.0)], atol=1e-6)
    assert np.isnan(mean[2]).all(), "not covered by the truth"


def test_packed_covariances_are_unpacked_in_the_table_s_order() -> None:
    expected = [[1.0, 4.0, 5.0], [4.0, 2.0, 6.0], [5.0, 6.0, 3.0]]
    assert covariance_matrices(np.array([[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]))[0].tolist() == expected


@pytest.mark.parametrize("changes", [{}, {"truth": False}, {"identity": False}, {"commands": False}])
def test_the_summary_is_strict_json(tmp_path: Path, changes: dict[str, object]) -> None:
    summary = summarise(short(tmp_path, **changes))
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary


def test_the_text_shows_the_table_of_the_thesis(full: Run) -> None:
    text = format_report(summarise(full))
    assert "3  -0.100 -> +0.000" in text
    supply = "average supply power at the coils"
    for row in ("steady-state error", "overshoot", "rise time", "settling time", supply):
        (line,) = [line for line in text.splitlines() if line.strip().startswith(row)]
        assert line.endswith("pass")
    assert "  supply power V |I| at the coils   average 34.0 mW, maximum 0.340 W, total 23.80 J\n" in text
    assert "  supply power measured at the bus  average 50.0 mW\n" in text
    assert "  consumption stated in the thesis  average about 100 mW, maximum about 0.5 W\n" in text
    assert "  heat R I^2 of steady currents     average 23.000 mW, total 16.100 J\n" in text
    assert "planner: 3 jobs (done 3)" in text
    assert max(len(line) for line in text.splitlines()) <= 120


def test_the_text_of_a_run_without_optional_packets_states_the_missing_results(tmp_path: Path) -> None:
    changes = {"truth": False, "identity": False, "performance": False, "commands": False, "duration": 0.5}
    text = format_report(summarise(short(tmp_path, **changes)))
    assert "note: no target packets" in text
    assert "unknown" in text


# Values of single packets.


def test_the_identity_of_a_run_is_that_of_its_packets() -> None:
    first = {
        "config_name": "demo", "config_crc": 77, "software": "1.2", "seed": 9, "utc_ns": 5, "simulated": 1,
        "realtime": 0, "control_period_ns": 25_000_000, "duration": 10.0,
    }  # fmt: skip
    later = first | {"utc_ns": 12, "seed": 10}
    run = packed_run(run=[(0.0, first), (2.0, later)], control=[(9.93, {})])
    assert summarise(run)["run"] == {
        "folder": "run", "duration_s": 9.93, "cut_short": False, "duration_planned_s": 10.0,
        "config_name": "demo", "config_crc": 77, "software": "1.2", "seed": 9, "utc_ns": 12,
        "simulated": True, "realtime": False, "control_period_s": 0.025,
    }  # fmt: skip
    short_run = packed_run(run=[(0.0, first)], control=[(9.92, {})])
    assert summarise(short_run)["run"]["cut_short"], "more than three periods are missing"


def test_health_states_shares_of_good_streams_conditions_and_worst_values() -> None:
    """The share of good states is reported for each stream, except for streams that are never fitted."""
    states = StreamState.GOOD, StreamState.STALE, StreamState.NOT_FITTED
    good, lost, not_fitted = map(int, states)
    rows = [
        (1.0, {"imu": good, "field": good, "coils": lost, "power": not_fitted, "camera": not_fitted,
               "facts": 0b101, "fed": 3, "clock_steps": 1, "cpu_share": 0.5, "proportional": 2e8,
               "memory_slope": 1.0, "disk_free": 9e9, "temperature": math.nan}),
        (2.0, {"imu": good, "field": lost, "coils": lost, "power": not_fitted, "camera": good,
               "facts": 0b1, "fed": 4, "clock_steps": 2, "cpu_share": 0.2, "proportional": 1e8,
               "memory_slope": 0.5, "disk_free": 8e9, "temperature": math.nan}),
        (3.0, {"imu": good, "field": good, "coils": lost, "power": not_fitted, "camera": good,
               "facts": 0, "fed": 5, "clock_steps": 2, "cpu_share": math.nan, "proportional": math.nan,
               "memory_slope": math.nan, "disk_free": math.nan, "temperature": math.nan}),
    ]  # fmt: skip
    found = summarise(packed_run(health=rows))["health"]
    assert found["streams_good"] == pytest.approx({"imu": 1.0, "field": 2 / 3, "coils": 0.0, "camera": 2 / 3})
    assert found["facts"] == [FACTS[0].name, FACTS[2].name]
    assert (found["watchdog_fed"], found["clock_steps"]) == (5, 2)
    assert (found["cpu_share"], found["proportional_bytes"]) == pytest.approx((0.5, 2e8))
    assert (found["memory_slope_bytes_per_hour"], found["disk_free_bytes"]) == pytest.approx((1800.0, 8e9))
    assert found["temperature_c"] is None
    assert summarise(packed_run(event=[(0.0, {"name": "x"})]))["health"] is None


def test_cycles_jobs_rate_groups_and_plans_have_their_statistics() -> None:
    timing = [(0.1 * k, {"lateness": 1e-5 * k, "execution": 2e-5 * k}) for k in range(101)]
    control = [(0.1 * k, {"cycle": cycle}) for k, cycle in enumerate((10, 11, 14, 15))]
    jobs = [
        (1.0, {"name": "vision", "execution": 0.3, "outcome": "done"}),
        (2.0, {"name": "planner", "execution": 0.1, "outcome": "done"}),
        (3.0, {"name": "vision", "execution": 0.5, "outcome": "failed"}),
        (4.0, {"name": "vision", "execution": 0.1, "outcome": "done"}),
    ]
    groups = [
        (
            1.0,
            {"name": "slow", "period": 1.0, "cycles": 5, "slips": 1, "overruns": 2, "mean": 0.1, "max": 0.2},
        ),
        (1.0, {"name": "fast", "period": 0.1, "cycles": 40}),
        (
            2.0,
            {
                "name": "fast",
                "period": 0.1,
                "cycles": 50,
                "slips": 3,
                "overruns": 4,
                "mean": 0.01,
                "max": 0.03,
            },
        ),
    ]
    plans = [
        (1.0, {"accepted": 1, "status": "solved", "horizon": 10.0, "peak_current": 0.05}),
        (2.0, {"accepted": 1, "status": "stretched", "horizon": 13.0, "peak_current": 0.04}),
        (3.0, {"accepted": 0, "status": "infeasible", "horizon": 99.0, "peak_current": 0.9}),
        (4.0, {"accepted": 0, "status": "stretched", "horizon": 99.0, "peak_current": 0.9}),
    ]
    found = summarise(
        packed_run(cycle_timing=timing, control=control, job_timing=jobs, rate_group=groups, plan=plans)
    )
    assert (found["cycles"]["count"], found["cycles"]["skipped"]) == (4, 2)
    assert found["cycles"]["lateness_s"] == pytest.approx({"p50": 5e-4, "p99": 9.9e-4, "max": 1e-3})
    assert found["cycles"]["execution_s"] == pytest.approx({"p50": 1e-3, "p99": 1.98e-3, "max": 2e-3})
    planner, vision = found["jobs"]
    assert (planner["name"], planner["count"], planner["outcomes"]) == ("planner", 1, {"done": 1})
    assert (vision["name"], vision["count"], vision["outcomes"]) == ("vision", 3, {"done": 2, "failed": 1})
    assert vision["execution_s"] == pytest.approx({"p50": 0.3, "p99": 0.496, "max": 0.5})
    fast, slow = found["rate_groups"]
    assert fast == {
        "name": "fast", "period_s": pytest.approx(0.1), "cycles": 50, "slips": 3, "overruns": 4,
        "mean_s": pytest.approx(0.01), "max_s": pytest.approx(0.03),
    }  # fmt: skip
    assert (slow["name"], slow["cycles"], slow["slips"], slow["overruns"]) == ("slow", 5, 1, 2)
    assert found["planner"] == {
        "plans": 4, "accepted": 2, "refused": 2, "stretched": 1,
        "refusals": {"infeasible": 1, "stretched": 1},
        "longest_horizon_s": 13.0, "peak_current_a": pytest.approx(0.05),
    }  # fmt: skip
    empty = summarise(packed_run(event=[(0.0, {"name": "x"})]))
    assert empty["cycles"] == {
        "count": 0, "missing": 0, "skipped": 0, "lateness_s": None, "execution_s": None
    }  # fmt: skip
    assert (empty["planner"]["longest_horizon_s"], empty["planner"]["peak_current_a"]) == (None, None)


def test_events_are_counted_with_those_that_were_suppressed_and_coils_are_listed() -> None:
    broken, trusted = events.COIL_BROKEN.name, events.COIL_TRUSTED.name
    rows = [
        (1.5, {"name": "b", "severity": 2, "text": "first", "suppressed": 4}),
        (2.0, {"name": broken, "severity": 3, "text": "coil x"}),
        (2.5, {"name": "b", "severity": 1, "text": "second", "suppressed": 1}),
        (3.0, {"name": trusted, "severity": 1, "text": "coil x again"}),
    ]
    found = summarise(
        packed_run(event=rows, mode=[(1.0, {"mode": int(Mode.DETUMBLE), "trigger": "t", "reason": "r"})])
    )
    assert found["events"][0] == {"name": "b", "count": 7, "severity": 2, "first_s": 1.5, "text": "first"}
    assert [one["name"] for one in found["events"]] == ["b", broken, trusted]
    assert found["coils"] == [
        {"time_s": 2.0, "name": broken, "text": "coil x"},
        {"time_s": 3.0, "name": trusted, "text": "coil x again"},
    ]
    assert found["modes"] == [{"mode": Mode.DETUMBLE.label, "at_s": 1.0, "trigger": "t", "reason": "r"}]


def test_the_largest_currents_and_the_mean_power_are_those_of_the_log() -> None:
    control = [(0.1 * k, {"current_written": [0.01 * k, -0.09, 0.0]}) for k in range(5)]
    truth = [(0.1 * k, {"current": [0.0, 0.02, -0.12]}) for k in range(5)]
    housekeeping = [(float(k), {"coil_power": 0.1 * k}) for k in (1, 2, 3)]
    power = summarise(packed_run(control=control, truth=truth, housekeeping=housekeeping))["power"]
    assert power["peak_current_a"] == pytest.approx(0.09)
    assert power["peak_current_actual_a"] == pytest.approx(0.12)
    assert power["bus_average_w"] == pytest.approx(0.2)
