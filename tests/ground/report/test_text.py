"""Tests of the units and digits of each value in the text of an artificial summary."""

from __future__ import annotations

import math
from typing import Any

import pytest

from ground.report.text import ARCSECONDS, DEGREES, format_report, number, provenance, table

ARCSECOND, DEGREE = math.pi / 648_000.0, math.pi / 180.0

EMPTY: dict[str, Any] = {
    "run": {"folder": "runs/a", "duration_s": 12.34},
    "steps": [],
    "detumbling": None,
    "knowledge": None,
    "pointing": None,
    "requirements": [],
    "thesis": [],
    "power": {"source": None},
    "rate_groups": [],
    "cycles": {"count": 7, "missing": 1, "skipped": 2, "lateness_s": None, "execution_s": None},
    "jobs": [],
    "planner": {"plans": 0},
    "estimate": None,
    "streaks": {"frames": 0},
    "stars": {"frames": 0},
    "star_camera": None,
    "lens": None,
    "failed_frames": [],
    "objects": [],
    "modes": [],
    "health": None,
    "events": [],
    "coils": [],
    "logs": [],
    "notes": ["one", "two"],
}
LOGS = (
    "Log integrity\n"
    "  log  packets  bytes  skipped bytes  truncated bytes  missing packets  other versions  dropped segments"
)


def blocks(**changes: Any) -> list[str]:
    """Return the sections of the report after the headline, without the sections on loop, logs and notes."""
    found = format_report({**EMPTY, **changes}).removesuffix("\n").split("\n\n")
    assert found[0] == "Run runs/a: 12.3 s"
    assert found[-2:] == [LOGS, "note: one\nnote: two"]
    return found[1:-2]


HOST = ", in host time; the flight ran in lock-step"
CYCLES = "Control cycles in the log: 7, missing from the log: 1; slots skipped by the loop: 2"


def test_an_empty_run_has_its_headline_its_cycles_and_its_notes() -> None:
    assert blocks() == [CYCLES]


def test_numbers_have_their_digits_and_scale_and_a_dash_for_none() -> None:
    assert (number(1.2345), number(1.2345, 1), number(0.5, 0, 100.0), number(None)) == (
        "1.23",
        "1.2",
        "50",
        "-",
    )
    assert pytest.approx(1.0) == ARCSECOND * ARCSECONDS
    assert pytest.approx(1.0) == DEGREE * DEGREES


def test_columns_are_aligned_the_first_left_and_the_others_right() -> None:
    assert table(["a", "bb"], [["ccc", "1"], ["d", "222"]]) == ["  a     bb", "  ccc    1", "  d    222"]


@pytest.mark.parametrize(
    ("simulated", "realtime", "text"),
    [
        (True, False, "demo on simulated devices, seed 5, lock-step, software 1.2"),
        (True, True, "demo on simulated devices, seed 5, real time, software 1.2"),
        (False, True, "demo on real devices, real time, software 1.2"),
    ],
)
def test_the_origin_of_a_run_is_stated(simulated: bool, realtime: bool, text: str) -> None:
    run = {"config_name": "demo", "seed": 5, "simulated": simulated, "realtime": realtime, "software": "1.2"}
    assert provenance(run) == text
    assert provenance({}) == ""


def test_the_utc_of_mission_time_zero_is_stated() -> None:
    run = EMPTY["run"] | {"utc_ns": 1_700_000_000_000_000_000}
    lines = format_report(EMPTY | {"run": run}).splitlines()
    assert lines[:2] == ["Run runs/a: 12.3 s", "mission time 0 s is 2023-11-14T22:13:20.000Z"]


def test_steps_are_listed_with_their_figures() -> None:
    step = {
        "index": 3, "again": False, "from_q2": -0.1, "target_q2": 0.25, "start_s": 10.04,
        "steady_state_deg": 0.123, "overshoot_percent": 4.56, "rise_s": 3.456, "rise_judged": True,
        "settling_s": None,
    }  # fmt: skip
    unjudged = {**step, "index": 4, "again": True, "from_q2": None, "rise_judged": False}
    [text, _] = blocks(steps=[step, unjudged], attitude_source="truth")
    lines = text.splitlines()
    assert lines[0] == "Attitude steps, judged on the true attitude"
    assert lines[2].split() == ["3", "-0.100", "->", "+0.250", "10.0", "0.12", "4.6", "3.46", "-"]
    assert lines[3].split() == ["4", "again", "-", "->", "+0.250", "10.0", "0.12", "4.6", "3.46", "*", "-"]
    assert lines[4].startswith("  * the step began at the release")
    [text, _] = blocks(steps=[step], attitude_source="estimate")
    assert "judged on the estimated attitude" in text
    assert "* the step" not in text


def test_detumbling_is_in_degrees_a_second() -> None:
    period = {
        "begin_s": 1.04, "duration_s": 20.0, "first_rate_rad_s": 3.0 * DEGREE, "slowed": True,
        "largest_rate_rad_s": 4.0 * DEGREE, "last_rate_rad_s": 0.125 * DEGREE,
    }  # fmt: skip
    found = {
        "periods": [period, {**period, "slowed": False}], "rate_known_share": 0.255,
        "rate_error_rms_rad_s": 0.0126 * DEGREE, "rate_source": "imu", "restarts": 4,
    }  # fmt: skip
    [text, _] = blocks(detumbling=found)
    lines = text.splitlines()
    assert lines[0] == "Detumbling, rates from the gyro"
    assert lines[2].split() == ["1.0", "20.0", "3.00", "4.00", "0.12", "yes"]
    assert lines[3].split()[-1] == "no"
    assert lines[4] == (
        "  rate from the magnetometer alone: available 25.5 % of the time, 0.013 deg/s rms error per axis, "
        "4 restarts"
    )
    assert "rates from the truth" in blocks(detumbling={**found, "rate_source": "truth"})[0]
    [unknown, _] = blocks(detumbling={**found, "rate_error_rms_rad_s": None})
    assert unknown.splitlines()[4] == (
        "  rate from the magnetometer alone: available 25.5 % of the time, 4 restarts"
    )


def test_knowledge_is_in_degrees_and_percent() -> None:
    found = {
        "share": {"lost": 0.1, "fine": 0.9}, "fine_after_s": 61.25, "fine_error_rms_rad": 0.01 * DEGREE,
        "with_stars_error_rms_rad": 0.002 * DEGREE, "fine_error_worst_rad": 0.03 * DEGREE,
        "worst_sigmas": 3.14, "nees_per_axis": 1.049, "refused": 5, "fixes_refused": 6, "restarts": 7,
        "dipole_error_share": {"sunlight": 0.126, "shadow": 0.054},
        "dipole_judged_s": {"sunlight": 600.0, "shadow": 90.0},
        "star_camera": {"with_stars_error_rms_rad": 0.003 * DEGREE, "nees_per_axis": 0.987},
        "description": [{"name": "inertia", "first_error": 0.0123, "error": 0.00045, "sigma": 0.00067}],
    }  # fmt: skip
    [text, _] = blocks(knowledge=found)
    assert text.splitlines() == [
        "Attitude knowledge",
        "  lost 10.0 %, fine 90.0 %; first fine at 61.2 s",
        "  error of the fine attitude 0.0100 deg rms over three axes (0.0020 with stars), maximum 0.0300 "
        "deg; maximum 3.1 sigma per axis, NEES per axis 1.05",
        "  error of the star camera's attitude 0.0030 deg rms with stars, NEES per axis 0.99",
        "  estimated parameters, rms (inertia divided by its trace, camera in rad):",
        "  inertia: error 0.012 at the start, 0.00045 at the end, one sigma 0.00067",
        "  error of the residual dipole in the last 10.0 min in sunlight: 13 %",
        "  error of the residual dipole in the last 1.5 min in shadow: 5 %",
        "  5 measurements and 6 fixes refused, 7 restarts",
    ]
    [unknown, _] = blocks(knowledge={**found, "fine_error_rms_rad": None})
    assert "error of the fine attitude" not in unknown


def test_pointing_is_in_degrees_and_milliwatts() -> None:
    target = {
        "target": "nadir", "begin_s": 1.0, "duration_s": 2.0, "axis_rms_rad": 1.5 * DEGREE,
        "axis_worst_rad": 2.5 * DEGREE, "all_axes_rms_rad": 3.5 * DEGREE, "supply_w": 0.0125,
        "heat_w": 0.0015,
    }  # fmt: skip
    [text, _] = blocks(pointing={"source": "truth", "settled_after_s": 600.0, "targets": [target]})
    lines = text.splitlines()
    assert lines[0] == "Pointing, true attitude"
    assert lines[2].split() == ["nadir", "1.0", "2.0", "1.50", "2.50", "3.50", "12.50", "1.50"]
    assert lines[3].startswith("  errors count from 600 s after the start")
    [text, _] = blocks(pointing={"source": "estimate", "settled_after_s": 600.0, "targets": [target]})
    assert text.startswith("Pointing, estimated attitude")


def test_objects_are_in_degrees_a_second_and_arcseconds() -> None:
    row = {
        "number": 2, "first_s": 1.0, "last_s": 9.0, "seen": 3, "frames": 5, "magnitude": 4.44,
        "rate_least_rad_s": 0.5 * DEGREE, "rate_most_rad_s": 1.5 * DEGREE,
        "sighting_sigma_rad": 12.5 * ARCSECOND,
    }  # fmt: skip
    [text, _] = blocks(objects=[row, {**row, "sighting_sigma_rad": None}])[::-1]
    assert text.splitlines()[2].split() == [
        "2",
        "1.0",
        "9.0",
        "3",
        "of",
        "5",
        "0.500",
        "1.500",
        "4.4",
        "12.50",
    ]
    assert text.splitlines()[3].split()[-1] == "-"


@pytest.mark.parametrize(("limit", "worst"), [(1.0, "0.12"), (0.99, "0.1235")])
def test_a_small_limit_has_more_digits(limit: float, worst: str) -> None:
    row = {"quantity": "error", "worst": 0.12346, "limit": limit, "unit": "deg", "verdict": "pass"}
    [text, _] = blocks(requirements=[row])
    assert text.splitlines()[0] == "Requirements of the configuration"
    assert text.splitlines()[2].split() == ["error", worst, f"{limit:g}", "deg", "pass"]


def test_the_coil_power_is_in_milliwatts_and_joules() -> None:
    power = {
        "source": "truth",
        "peak_current_a": 0.12346,
        "peak_current_actual_a": None,
        "supply_average_w": 0.0125,
        "supply_peak_w": 0.5,
        "supply_j": 3.0,
        "bus_average_w": 0.02,
        "heat_average_w": 0.0015,
        "heat_j": 0.25,
    }
    [text, _] = blocks(power=power)
    assert [line[36:] for line in text.splitlines()[1:]] == [
        "average 12.5 mW, maximum 0.500 W, total 3.00 J",
        "average 20.0 mW",
        "average 1.500 mW, total 0.250 J",
        "0.1235 A commanded",
    ]
    assert text.startswith("Coil power, from the currents in the coils (truth)\n")
    both = blocks(power={**power, "source": "written", "peak_current_actual_a": 0.1})[0]
    assert both.startswith("Coil power, from the commanded currents\n")
    assert both.endswith("0.1235 A commanded, 0.1000 A in the coils (truth)")
    assert "about 100 mW" not in both


def test_times_of_the_loop_are_in_milliseconds() -> None:
    group = {
        "name": "control",
        "period_s": 0.025,
        "cycles": 9,
        "slips": 1,
        "overruns": 2,
        "mean_s": 1e-3,
        "max_s": 2e-3,
    }
    times = {"p50": 1e-3, "p99": 2.5e-3, "max": 4e-3}
    jobs = [{"name": "vision", "count": 3, "outcomes": {"done": 2, "died": 1}, "execution_s": times}]
    cycles = {**EMPTY["cycles"], "lateness_s": times}
    [text] = blocks(rate_groups=[group], jobs=jobs, cycles=cycles)
    run = {**EMPTY["run"], "realtime": False}
    [of_host] = blocks(rate_groups=[group], jobs=jobs, cycles=cycles, run=run)
    assert of_host == text.replace("Rate groups", f"Rate groups{HOST}").replace("Times", f"Times{HOST}")
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert lines == [
        "Rate groups",
        "rate group period s cycles slips overruns mean ms max ms",
        "control 0.025 9 1 2 1.000 2.000",
        "Times",
        "median ms 99 % ms max ms",
        "lateness of a control cycle 1.000 2.500 4.000",
        "vision: 3 jobs (died 1, done 2) 1.000 2.500 4.000",
        CYCLES,
    ]


def test_the_planner_counts_its_plans() -> None:
    plans = {
        "plans": 9, "accepted": 7, "stretched": 2, "refused": 1, "refusals": {"late": 1},
        "longest_horizon_s": 12.34, "peak_current_a": 0.12346,
    }  # fmt: skip
    assert blocks(planner=plans)[-1].splitlines() == [
        "Planner",
        "  9 plans, 7 accepted (2 of them stretched), 1 refused (late 1)",
        "  longest horizon 12.3 s, largest planned current 0.1235 A",
    ]
    assert "1 refused\n" in blocks(planner={**plans, "refusals": {}})[-1]


def test_estimate_streaks_and_stars_have_their_errors() -> None:
    estimate = {
        "angle_rms_rad": 2e-3,
        "rate_rms_rad_s": 3e-4,
        "angle_normalised": 1.1,
        "rate_normalised": None,
    }
    found = {"frames": 4, "status": {"ok": 3}, "accepted": 2, "normalised": 0.9, "compared": 3}
    streaks = {**found, "rates": 3, "rms_error": [1e-3, 2e-3, 3e-3]}
    stars = {**found, "tracked": 1, "matched": 11.0, "rms_error": [ARCSECOND, 2 * ARCSECOND, 30 * ARCSECOND]}
    assert blocks(estimate=estimate, streaks=streaks, stars=stars)[-1].splitlines() == [
        "Estimate: rms error 2.000 mrad, 0.300 mrad/s; divided by the estimated sigma 1.10, -",
        "Streaks: 4 frames (ok 3), 3 rates, 2 used by the estimator",
        "  rms error x, y, z 1.000, 2.000, 3.000 mrad/s over 3 rates; NEES per axis 0.90",
        "Stars:   4 frames (ok 3), 1 tracked, median of 11 matches, 2 used by the estimator",
        "  rms error about x, y, z 1.00, 2.00, 30.00 arcsec over 3 attitudes; NEES per axis 0.90",
    ]
    assert len(blocks(streaks={**streaks, "rms_error": None})[-1].splitlines()) == 1


def test_the_availability_of_the_star_camera_is_stated() -> None:
    found = {"instants": 90, "slow": 60, "unobstructed": 48, "measured": 42, "share": 0.875}
    lines = blocks(star_camera={**found, "longest_gap_s": 30.0})[-1].splitlines()
    first = "Star camera: attitude or rate at 42 of 48 unobstructed exposures (87.5 %); longest gap 30 s"
    assert lines[0] == first
    assert lines[1].startswith("  90 scheduled exposures, 60 of them below camera.max_rate;")
    never = {**found, "unobstructed": 0, "measured": 0, "share": None, "longest_gap_s": 0.0}
    assert "0 of 0 unobstructed exposures; longest" in blocks(star_camera=never)[-1]


@pytest.mark.parametrize(("count", "more"), [(20, ""), (23, "  and 3 more lines; --json lists all frames")])
def test_successive_failed_frames_of_one_cause_share_one_of_up_to_twenty_lines(count: int, more: str) -> None:
    causes = ("too-few", "saturated")
    frames = [
        {"sequence": k, "exposed_s": 0.5 * k, "streaks": causes[k // 3 % 2], "stars": None}
        for k in range(3 * count)
    ]
    lines = blocks(failed_frames=frames)[-1].splitlines()
    assert lines[0] == f"Frames without rate or attitude: {3 * count}"
    assert lines[3].split() == ["3", "1.5", "2.5", "saturated", "-"]
    assert len(lines) == 2 + 20 + bool(more)
    assert not more or lines[-1] == more


def test_judgements_of_coils_are_listed_with_their_texts() -> None:
    row = {
        "time_s": 9.2,
        "name": "coil-corrected",
        "text": "coil y: used with -1.00 of its configured dipole",
    }
    assert blocks(coils=[row])[-1].splitlines() == [
        "Coils",
        "  9.2 s  coil-corrected: coil y: used with -1.00 of its configured dipole",
    ]


def test_modes_health_and_events_are_listed() -> None:
    modes = [{"mode": "hold", "at_s": 1.5, "trigger": "arrived", "reason": ""}]
    health = {
        "streams_good": {"imu": 0.987}, "facts": [], "watchdog_fed": 5, "clock_steps": 1, "cpu_share": 0.256,
        "proportional_bytes": 3 * 2**20, "temperature_c": 45.67, "memory_slope_bytes_per_hour": 2**19,
        "disk_free_bytes": 7 * 2**20,
    }  # fmt: skip
    events = [
        {"name": "started", "severity": 0, "count": 1, "first_s": 0.25},
        {"name": "x", "severity": 9, "count": 2, "first_s": 1},
    ]
    mode_text, health_text, event_text = blocks(modes=modes, health=health, events=events)[1:]
    assert mode_text.splitlines()[2].split() == ["hold", "1.500", "arrived", "-"]
    assert health_text.splitlines() == [
        "Health: share of time with good readings: imu 98.7 %",
        "  conditions detected: none; watchdog fed 5 times, wall clock set 1 times",
        "  maximum 0.26 of a core, 3 MiB, 45.7 deg C, memory slope 0.50 MiB/h, 7 MiB of disk free",
    ]
    health |= {"temperature_c": None, "memory_slope_bytes_per_hour": None}
    [_, without] = blocks(health=health)
    assert without.splitlines()[2] == "  maximum 0.26 of a core, 3 MiB, 7 MiB of disk free"
    assert [line.split() for line in event_text.splitlines()[2:]] == [
        ["started", "information", "1", "0.250"],
        ["x", "9", "2", "1.000"],
    ]
    assert len(blocks(health={**health, "proportional_bytes": None})[-1].splitlines()) == 2
