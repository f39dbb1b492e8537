"""Tests of an orbit run's results from artificial packets. Expected values are computed by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from flight.link import events
from flight.link.events import Mode
from flight.schema import reader as configuration
from flight.schema.bodies import Requirements, as_orbit
from ground.report import orbit
from ground.report.signals import PowerHistory
from knightcube.astro.quaternion import from_rotation_vector
from tests.support.flights import CONFIG
from tests.support.packed_run import packed_run

NAN4 = [math.nan] * 4
UPRIGHT = [0.0, 0.0, 0.0, 1.0]


def turned(x: float, y: float = 0.0, z: float = 0.0) -> list[float]:
    """Return the attitude quaternion of a small rotation vector (rad)."""
    return [float(part) for part in from_rotation_vector(np.array([x, y, z]))]


def modes(*rows: tuple[float, Mode]) -> list[tuple[float, dict[str, Any]]]:
    """Return mode packets."""
    return [(time, {"mode": int(mode)}) for time, mode in rows]


def test_a_period_of_detumbling_lasts_to_the_next_mode_or_to_the_end() -> None:
    run = packed_run(
        mode=modes(
            (0.0, Mode.BOOT),
            (1.0, Mode.DETUMBLE),
            (5.0, Mode.ACQUIRE),
            (7.0, Mode.DETUMBLE),
            (8.0, Mode.SAFE),
            (9.0, Mode.DETUMBLE),
            (9.5, Mode.HOLD),
            (10.0, Mode.DETUMBLE),
        )
    )
    assert orbit.detumbling_periods(run, 12.0) == [
        (1.0, 5.0, True),
        (7.0, 8.0, False),
        (9.0, 9.5, True),
        (10.0, 12.0, False),
    ]


def test_detumbling_has_the_rates_of_its_period_and_the_error_of_the_magnetometer() -> None:
    truth = [(float(t), {"rate": [0.3 - 0.05 * t, 0.0, 0.4]}) for t in range(6)]
    spin: list[tuple[float, dict[str, Any]]] = [
        (1.0, {"known": 0, "rate": [math.nan] * 3}),
        (2.5, {"known": 1, "rate": [0.175 + 0.03, 0.0, 0.44], "restarts": 1}),
        (3.0, {"known": 1, "rate": [0.15 + 0.03, 0.0, 0.36], "restarts": 3}),
        (4.0, {"known": 0, "restarts": 3}),
    ]
    run = packed_run(truth=truth, spin=spin, mode=modes((1.0, Mode.DETUMBLE), (4.0, Mode.ACQUIRE)))
    found = orbit.detumbling(run)
    assert found is not None
    assert (found["rate_source"], found["restarts"], found["rate_known_share"]) == ("truth", 3, 0.5)
    assert found["rate_error_rms_rad_s"] == pytest.approx(math.sqrt((0.03**2 + 0.04**2) / 3))
    late = orbit.detumbling(packed_run(truth=truth[3:], spin=spin))
    assert late is not None
    assert late["rate_error_rms_rad_s"] == pytest.approx(found["rate_error_rms_rad_s"]), "of one row"
    (period,) = found["periods"]
    assert (period["begin_s"], period["duration_s"], period["slowed"]) == (1.0, 3.0, True)
    assert period["first_rate_rad_s"] == pytest.approx(math.hypot(0.25, 0.4))
    assert period["largest_rate_rad_s"] == period["first_rate_rad_s"]
    assert period["last_rate_rad_s"] == pytest.approx(math.hypot(0.1, 0.4))
    assert orbit.detumbling(packed_run(truth=truth)) is None
    alone = orbit.detumbling(packed_run(spin=spin, mode=modes((1.0, Mode.DETUMBLE))))
    assert alone is not None
    assert alone["rate_source"] == "imu"
    assert math.isnan(alone["rate_error_rms_rad_s"])
    assert alone["periods"][0]["duration_s"] == 3.0, "up to the last spin packet"
    assert math.isnan(alone["periods"][0]["largest_rate_rad_s"])


def test_readings_without_a_rate_do_not_hide_the_rates_of_a_detumbling() -> None:
    """A gyro that fails during detumbling sends NaN."""
    spin = [(float(second), {"rate": [0.1, 0.0, 0.0], "known": 1}) for second in range(4)]
    rates = (math.nan, 0.2, 0.1, math.nan)
    readings = [(float(second), {"rate": [rate, 0.0, 0.0]}) for second, rate in enumerate(rates)]
    mode = [(0.0, {"mode": Mode.DETUMBLE})]
    found = orbit.detumbling(packed_run(spin=spin, imu=readings, mode=mode))
    assert found is not None
    (period,) = found["periods"]
    assert [period[f"{name}_rate_rad_s"] for name in ("first", "largest", "last")] == [0.2, 0.2, 0.1]


def test_knowledge_counts_errors_while_fine_and_shortly_after_stars() -> None:
    """Attitude errors are evaluated while the attitude is fine, and also shortly after star fixes.

    The errors about x are 1 mrad (coarse), 2 and 3 mrad (with star fixes) and 6 mrad (without star fixes).
    Sigma is 1 mrad.
    """
    levels = [(0.0, 0), (1.0, 1), (2.0, 2), (30.0, 2)]
    sigma = {"angle_sigma": [1e-3] * 3}
    attitude: list[tuple[float, dict[str, Any]]] = [
        (0.5, {"quaternion": NAN4}),
        (1.5, {"quaternion": turned(-1e-3), **sigma}),
        (3.0, {"quaternion": turned(-2e-3), **sigma}),
        (12.0, {"quaternion": turned(-3e-3), **sigma}),
        (13.0, {"quaternion": turned(-6e-3), **sigma}),
        (31.0, {"quaternion": turned(-9e-3), **sigma}),
    ]
    run = packed_run(
        navigation=[
            (t, {"knowledge": k, "refused": 4, "fixes_refused": 5, "restarts": 6}) for t, k in levels
        ],
        attitude=attitude,
        stars=[(2.5, {"accepted": 1}), (25.0, {"accepted": 0})],
        truth=[(t, {"quaternion": UPRIGHT}) for t in (0.5, 1.5, 3.0, 12.0, 13.0)],
    )
    found = orbit.knowledge(run)
    assert found is not None
    assert found["share"] == {"lost": 0.25, "coarse": 0.25, "fine": 0.5}
    assert found["fine_after_s"] == 2.0
    assert found["fine_error_rms_rad"] == pytest.approx(math.sqrt((4 + 9 + 36) / 3) * 1e-3)
    assert found["with_stars_error_rms_rad"] == pytest.approx(math.sqrt((4 + 9) / 2) * 1e-3)
    assert found["fine_error_worst_rad"] == pytest.approx(6e-3)
    assert found["worst_sigmas"] == pytest.approx(6.0, rel=1e-5)
    assert found["nees_per_axis"] == pytest.approx((4 + 9 + 36) / 9, rel=1e-5)
    assert (found["refused"], found["fixes_refused"], found["restarts"]) == (4, 5, 6)
    assert found["star_camera"] is None
    assert found["description"] == []
    assert orbit.knowledge(packed_run(attitude=attitude)) is None
    assert math.isnan(found["dipole_error_share"]["sunlight"])
    assert found["dipole_judged_s"] == {"sunlight": 0.0, "shadow": 0.0}
    errors = orbit.attitude_errors(run)
    assert errors.times.tolist() == [1.5, 3.0, 12.0, 13.0], "only where the truth is known"
    np.testing.assert_allclose(errors.error[:, 0], [1e-3, 2e-3, 3e-3, 6e-3], rtol=1e-6)


def test_the_error_of_the_dipole_is_relative_to_its_size() -> None:
    def lit(time: float) -> float:
        return {0: 1.0, 1: 0.0, 2: 0.5, 3: 0.99}[int(time)]

    times = (0.0, 1.0, 2.0, 3.0)
    run = packed_run(
        navigation=[(t, {"residual_dipole": [1.1e-3 if t == 0 else 1.5e-3, 0.0, 0.0]}) for t in times],
        orbit_truth=[(t, {"residual_dipole": [1e-3, 0.0, 0.0], "sunlit": lit(t)}) for t in times],
    )
    assert orbit.dipole_errors(run) == pytest.approx({"sunlight": 0.1, "shadow": 0.5})
    without = packed_run(
        navigation=[(0.0, {"residual_dipole": [1e-10, 0.0, 0.0]})], orbit_truth=[(0.0, {"sunlit": 1.0})]
    )
    assert orbit.dipole_errors(without)["sunlight"] == pytest.approx(0.1), "at least 1e-9 A m^2"


def test_an_estimate_after_the_last_true_state_is_compared_with_that_state() -> None:
    """An estimate that is later than the last true state is compared with the last true state.

    The flight log and the truth log of a run do not end at the same time.
    """
    run = packed_run(
        navigation=[(t, {"residual_dipole": [2e-3, 0.0, 0.0]}) for t in (1.0, 1.5)],
        orbit_truth=[
            (t, {"residual_dipole": [x, 0.0, 0.0], "sunlit": 1.0}) for t, x in ((0.0, 9e-3), (1.0, 2e-3))
        ],
    )
    assert orbit.dipole_errors(run)["sunlight"] == pytest.approx(0.0, abs=1e-6)


def flown(time: float, x: float, z: float = 0.0, mode: Mode = Mode.POINT) -> tuple[float, dict[str, Any]]:
    """Return an attitude packet with a given error from its target."""
    return time, {"mode": int(mode), "quaternion": turned(x, 0.0, z), "target": UPRIGHT}


def named(time: float, kind: events.EventKind, text: str = "") -> tuple[float, dict[str, Any]]:
    """Return an event packet."""
    return time, {"code": kind.code, "name": kind.name, "text": text}


def test_pointing_is_judged_ten_minutes_after_a_target_or_from_the_end_of_its_first_slew() -> None:
    run = packed_run(
        attitude=[
            flown(0.0, 0.5),
            flown(599.0, 0.4),
            flown(600.0, 3e-3, 7e-3),
            flown(900.0, 4e-3),
            flown(950.0, 1.0, mode=Mode.DETUMBLE),
            flown(1000.0, 0.3),
            flown(1650.0, 0.2),
            flown(1700.0, 5e-3),
            (1800.0, {"mode": int(Mode.POINT), "quaternion": NAN4, "target": UPRIGHT}),
        ],
        event=[
            named(0.0, events.TARGET, "nadir"),
            named(1000.0, events.TARGET, "sun"),
            named(1700.0, events.SLEW_ENDED),
            named(1750.0, events.SLEW_ENDED),
        ],
    )
    power = PowerHistory(np.array([0.0, 950.0]), 1800.0, np.array([2.0, 4.0]), np.array([1.0, 3.0]), "truth")
    found = orbit.pointing(run, (0.0, 0.0, 1.0), power)
    assert found is not None
    assert (found["source"], found["settled_after_s"]) == ("estimate", 600.0)
    nadir, sun = found["targets"]
    assert (nadir["target"], nadir["begin_s"], nadir["duration_s"]) == ("nadir", 0.0, 900.0)
    assert nadir["axis_rms_rad"] == pytest.approx(math.sqrt((9 + 16) / 2) * 1e-3, rel=1e-4)
    assert nadir["axis_worst_rad"] == pytest.approx(4e-3, rel=1e-4)
    assert nadir["all_axes_rms_rad"] == pytest.approx(math.sqrt((9 + 49 + 16) / 2) * 1e-3, rel=1e-4)
    assert (nadir["supply_w"], nadir["heat_w"]) == (2.0, 1.0)
    assert (sun["target"], sun["begin_s"], sun["duration_s"]) == ("sun", 1000.0, 700.0)
    assert sun["axis_rms_rad"] == pytest.approx(5e-3, rel=1e-4)
    assert math.isnan(sun["supply_w"]), "no interval of the power begins in it"
    assert orbit.pointing(packed_run(), (0.0, 0.0, 1.0), None) is None


def test_an_object_has_the_figures_of_its_own_packets() -> None:
    def seen(time: float, number: int, **values: Any) -> tuple[float, dict[str, Any]]:
        return time, {"number": number, "middle_ns": round(time * 1e9), **values}

    run = packed_run(
        track=[
            seen(1.0, 2, seen=1, rate=[3e-3, 0.0, 4e-3], magnitude=4.0, measured_sigma=1e-5),
            seen(2.0, 2, seen=1, rate=[0.0, 0.0, 6e-3], magnitude=5.0, measured_sigma=3e-5),
            seen(3.0, 2, rate=[0.0, 7e-3, 0.0], magnitude=9.0, measured_sigma=math.nan),
            seen(2.0, 1, rate=[1e-3, 0.0, 0.0], magnitude=math.nan),
            seen(3.0, 1, rate=[1e-3, 0.0, 0.0], magnitude=6.0),
        ]
    )
    first, second = orbit.objects(run)
    assert (first["number"], first["seen"], first["sighting_sigma_rad"]) == (1, 0, None)
    assert first["magnitude"] == 6.0, "unknown magnitudes do not count"
    assert second == {
        "number": 2, "first_s": 1.0, "last_s": 3.0, "frames": 3, "seen": 2,
        "rate_least_rad_s": pytest.approx(5e-3), "rate_most_rad_s": pytest.approx(7e-3),
        "magnitude": 5.0, "sighting_sigma_rad": pytest.approx(2e-5),
    }  # fmt: skip


def test_the_star_camera_is_judged_without_its_misalignment_and_the_body_with_it() -> None:
    tilt = np.array([1e-3, 0.0, -1e-3])
    unit = np.eye(3).ravel().tolist()
    matrices = {name: unit for name in ("coils", "gyro", "field")}
    sigmas = {f"{name}_sigma": [0.1] * 9 for name in matrices}
    inertia = [0.3, 0.3, 0.4, 0.0, 0.0, 0.1]
    doubled = [2.0 * one for one in inertia]
    # The attitude error of the body includes the misalignment. The attitude error of the star camera is 1e-4
    # rad about x.
    body = from_rotation_vector(tilt + np.array([1e-4, 0.0, 0.0])).tolist()
    packets: dict[str, Any] = {"stars": [(10.0, {"accepted": 1})]}
    packets |= dict(
        navigation=[(0.0, {"knowledge": 2})],
        attitude=[(t, {"quaternion": body, "angle_sigma": [2e-3] * 3}) for t in (0.5, 10.5, 40.5)],
        truth=[(t, {"quaternion": UPRIGHT}) for t in (0.5, 10.5, 40.5)],
        description=[
            (t, {**matrices, **sigmas, "inertia": doubled, "inertia_ratio_sigma": [0.01] * 6,
                 "camera": [0.0] * 3, "camera_sigma": [2e-3] * 3, "camera_attitude_sigma": [1e-4] * 3})
            for t in (0.5, 10.5, 20.5, 40.5)  # at 20.5 s, the attitude is unknown
        ],
        true_description=[(0.0, {**matrices, "inertia": inertia, "camera": (-tilt).tolist()})],
    )  # fmt: skip
    run = packed_run(**packets)
    found = orbit.knowledge(run)
    assert found is not None
    error = math.sqrt(2.1e-3**2 + 2e-3**2)
    assert found["with_stars_error_rms_rad"] == pytest.approx(math.sqrt(1.1e-3**2 + 1e-3**2), rel=1e-4)
    assert found["star_camera"]["with_stars_error_rms_rad"] == pytest.approx(error, rel=1e-3)
    assert orbit.camera_errors(run).times.tolist() == [0.5, 10.5, 40.5]
    rows = {row["name"]: row for row in found["description"]}
    assert rows["inertia"]["error"] == pytest.approx(0.0, abs=1e-12), "only the ratio to the trace counts"
    without = orbit.knowledge(packed_run(**packets | {"stars": []}))
    assert without is not None
    assert without["star_camera"] is None, "a satellite without star camera"
    assert rows["inertia"]["sigma"] == pytest.approx(0.01, rel=1e-6)
    assert rows["camera"]["error"] == pytest.approx(np.sqrt(np.mean(tilt**2)), rel=1e-6)


def test_every_requirement_is_judged_by_its_figure() -> None:
    config = as_orbit(configuration.load(CONFIG.with_name("orbit.yaml")))
    limits = Requirements(
        slow_within=100.0, fine_within=50.0, knowledge_deg=0.1, pointing_deg=5.0, camera_missed_percent=20.0
    )

    config = replace(config, requirements=limits)
    slowed = {"periods": [{"begin_s": 10.0, "duration_s": 80.0, "slowed": True}]}
    known = {"fine_after_s": 150.0, "with_stars_error_rms_rad": math.radians(0.05)}
    pointed = {"targets": [{"target": "nadir", "axis_rms_rad": math.radians(6.0)}]}
    rows = orbit.requirements(config, slowed, known, pointed, {"share": 0.75}, 300.0)
    found = [(row["quantity"], row["worst"], row["limit"]) for row in rows]
    assert found == [
        ("detumbling time", 80.0, 100.0),
        ("time from detumbling to fine attitude", 60.0, 50.0),
        ("attitude error with stars, rms", pytest.approx(0.05), 0.1),
        ("pointing to nadir, rms", pytest.approx(6.0), 5.0),
        ("unobstructed frames without attitude or rate", pytest.approx(25.0), 20.0),
    ]
    early = orbit.requirements(config, slowed, {**known, "fine_after_s": 20.0}, None, None, 300.0)
    assert early[1]["worst"] == 0.0
    never = orbit.requirements(config, slowed, {**known, "fine_after_s": math.nan}, None, None, 140.0)
    assert (never[1]["worst"], never[1]["verdict"]) == (math.inf, "miss")
    spinning = {"periods": [{"begin_s": 10.0, "duration_s": 80.0, "slowed": False}]}
    assert orbit.requirements(config, spinning, None, None, None, 110.0)[0]["worst"] == math.inf
    nothing = replace(config, requirements=Requirements())
    assert orbit.requirements(nothing, slowed, known, pointed, None, 300.0) == []
    # If the log ends before a time limit, the verdict is unknown.
    assert orbit.requirements(config, spinning, None, None, None, 109.0)[0]["verdict"] == "unknown"
    never = orbit.requirements(config, slowed, {**known, "fine_after_s": math.nan}, None, None, 139.0)
    assert never[1]["verdict"] == "unknown"


def test_a_residual_dipole_before_the_truth_log_has_no_error() -> None:
    learned = [(float(t), {"residual_dipole": [3e-3 if t < 5 else 1e-3, 0.0, 0.0]}) for t in range(10)]
    truth = [(float(t), {"residual_dipole": [1e-3, 0.0, 0.0], "sunlit": 1.0}) for t in range(5, 10)]
    found = orbit.dipole_errors(packed_run(navigation=learned, orbit_truth=truth))
    assert found["sunlight"] == pytest.approx(0.0)
    assert math.isnan(found["shadow"])
