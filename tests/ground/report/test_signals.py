"""Tests of the signals of a run from artificial packets. Expected values are computed by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from ground.report import signals
from ground.report.signals import PowerHistory
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from tests.support.packed_run import packed_run

POWER = PowerHistory(
    np.array([0.0, 1.0, 3.0]), 4.0, np.array([2.0, 4.0, 8.0]), np.array([1.0, 2.0, 3.0]), "truth"
)


def test_the_energy_and_averages_weigh_each_interval_by_its_length() -> None:
    np.testing.assert_array_equal(POWER.spans, [1.0, 2.0, 1.0])
    assert POWER.energy(POWER.supply) == 2.0 + 8.0 + 8.0
    assert POWER.average(POWER.supply) == 18.0 / 4.0
    assert POWER.average(POWER.heat, 1.0) == (4.0 + 3.0) / 3.0
    assert POWER.average(POWER.heat, 1.0, 3.0) == 2.0, "an interval that begins at the end is not inside"
    assert math.isnan(POWER.average(POWER.heat, 5.0))
    np.testing.assert_allclose(POWER.running_average(POWER.supply), [2.0, 10.0 / 3.0, 18.0 / 4.0])


def test_the_truth_is_interpolated_between_close_records_and_unknown_elsewhere() -> None:
    """The true attitude is interpolated between close records, and is NaN elsewhere.

    The body rotates by 0.02 rad per 0.025 s. The second record has a quaternion with the opposite sign.
    """
    times = (0.0, 1.0, 1.01, 1.025, 1.5, 2.0, 2.01)
    half = {1.0: 0.0, 1.01: 0.004, 1.025: 0.01, 2.0: 0.05}
    sign = {1.0: 1.0, 1.025: -1.0, 2.0: 1.0}
    truth = [
        (at, {"quaternion": [0.0, s * math.sin(half[at]), 0.0, s * math.cos(half[at])]})
        for at, s in sign.items()
    ]
    run = packed_run(truth=truth, imu=[(at, {}) for at in times])
    found = signals.true_quaternions(run["truth"], run["imu"])
    found *= np.sign(found[:, 3:])
    wanted = [math.sin(half[at]) if at in half else math.nan for at in times]
    np.testing.assert_allclose(found[:, 1], wanted, atol=1e-7)
    assert np.isnan(signals.true_quaternions(run["truth"][:0], run["imu"])).all()


def test_both_signs_of_the_true_quaternion_are_the_same_angle() -> None:
    turned = [0.0, 0.3, 0.0, math.sqrt(1.0 - 0.09)]
    run = packed_run(
        truth=[(0.0, {"quaternion": turned, "rate": [0.1, 0.2, 0.3]}),
               (1.0, {"quaternion": [-q for q in turned]})]
    )  # fmt: skip
    motion = signals.true_attitude(run)
    assert motion is not None
    np.testing.assert_allclose(motion.q2, [0.3, 0.3])
    np.testing.assert_allclose(motion.rate, [0.2, 0.0])
    assert motion.source == "truth"
    assert signals.true_attitude(packed_run()) is None


def test_cycles_without_an_estimate_are_left_out() -> None:
    run = packed_run(
        control=[(0.0, {"q2": math.nan}), (1.0, {"q2": 0.2, "rate": 0.1}), (2.0, {"rate": math.nan})]
    )
    motion = signals.estimated_attitude(run)
    assert (motion.time.tolist(), motion.q2.tolist(), motion.rate.tolist()) == ([1.0], [0.2], [0.1])


def test_the_true_power_is_the_increase_of_the_energy() -> None:
    run = packed_run(
        truth=[(t, {"energy": e, "supply_energy": 3.0 * e}) for t, e in ((0.0, 0.0), (2.0, 1.0), (3.0, 4.0))]
    )
    power = signals.coil_power(run)
    assert power is not None
    np.testing.assert_allclose(power.heat, [0.5, 3.0])
    np.testing.assert_allclose(power.supply, [1.5, 9.0])
    assert (power.time.tolist(), power.end, power.source) == ([0.0, 2.0], 3.0, "truth")


def test_without_the_truth_written_currents_flow_until_the_next_cycle() -> None:
    label = (0.0, {"coil_resistance": [10.0, 20.0, math.nan], "supply_voltage": 5.0})
    control = [(t, {"current_written": [0.1, -0.2, 0.0]}) for t in (0.0, 1.0, 2.0)]
    power = signals.coil_power(packed_run(run=[label], control=control))
    assert power is not None
    np.testing.assert_allclose(power.heat, [10.0 * 0.01 + 20.0 * 0.04] * 2)
    np.testing.assert_allclose(power.supply, [5.0 * 0.3] * 2)
    assert (power.end, power.source) == (2.0, "written")
    assert signals.coil_power(packed_run(control=control)) is None
    assert signals.coil_power(packed_run(run=[label], control=control[:1])) is None


def test_the_measured_power_leaves_unknown_values_out() -> None:
    run = packed_run(housekeeping=[(1.0, {"coil_power": math.nan}), (2.0, {"coil_power": 0.4})])
    times, power = signals.bus_power(run)
    assert (times.tolist(), power.tolist()) == ([2.0], [0.4])


def test_covariances_are_unpacked_in_the_order_xx_yy_zz_xy_xz_yz() -> None:
    (matrix,) = signals.covariance_matrices(np.array([[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]))
    np.testing.assert_array_equal(matrix, [[1, 4, 5], [4, 2, 6], [5, 6, 3]])


def test_the_mean_rate_over_an_exposure_is_the_integral_of_the_truth() -> None:
    """The mean rate over an exposure is the mean of the true rate.

    The rate about x equals the time, so its mean equals the time of mid-exposure.
    """
    run = packed_run(truth=[(float(t), {"rate": [float(t), 2.0, -1.0]}) for t in range(6)])
    start, stop = np.array([1.0, -0.5, 4.5, 2.0, 0.0]), np.array([3.0, 1.0, 5.5, 2.0, 5.0])
    means = signals.mean_rates(run["truth"], start, stop)
    np.testing.assert_allclose(means[0], [2.0, 2.0, -1.0])
    assert np.isnan(means[1:4]).all(), "before, after, and of no length"
    np.testing.assert_allclose(means[4], [2.5, 2.0, -1.0])
    assert np.isnan(signals.mean_rates(run["truth"][:1], start, stop)).all()


def test_rates_from_streaks_are_compared_with_the_truth_over_their_exposure() -> None:
    truth = [(float(t), {"rate": [0.1, 0.0, 0.0]}) for t in range(4)]
    good: dict[str, Any] = {
        "exposure_start_ns": 1_000_000_000,
        "exposure": 1.0,
        "status": "rate",
        "accepted": 1,
        "rate": [0.13, 0.04, 0.0],
        "covariance": [9e-4, 16e-4, 1e-4, 0.0, 0.0, 0.0],
    }
    bad: dict[str, Any] = {"status": "too-few", "rate": [math.nan] * 3, "covariance": [math.nan] * 6}
    reversed_sign = {**good, "rate": [-0.1, 0.0, 0.0], "status": "ambiguous", "accepted": 0}
    frames = [(1.0, good), (1.5, reversed_sign), (2.0, bad), (3.0, bad)]
    found = signals.streaks(packed_run(truth=truth, streak=frames))
    assert found["status"] == {"rate": 1, "ambiguous": 1, "too-few": 2}
    assert {key: found[key] for key in ("frames", "rates", "accepted", "compared")} == {
        "frames": 4, "rates": 2, "accepted": 1, "compared": 1,
    }  # fmt: skip
    np.testing.assert_allclose(found["rms_error"], [0.03, 0.04, 0.0])
    assert found["normalised"] == pytest.approx((1.0 + 1.0 + 0.0) / 3.0)


def test_star_attitudes_are_compared_with_the_truth_at_the_middle_of_the_exposure() -> None:
    truth = [
        (t, {"quaternion": from_rotation_vector(np.array([0.0, 0.0, 0.1 * t])).tolist()}) for t in (1.0, 2.0)
    ]
    attitude = from_rotation_vector(np.array([0.0, 0.0, 0.153])).tolist()
    frames = [
        (1.5, {"middle_ns": 1_500_000_000, "quaternion": attitude, "matched": 9, "tracked": 1, "accepted": 1,
               "status": "solved", "covariance": [9e-6, 9e-6, 9e-6, 0.0, 0.0, 0.0]}),
        (1.6, {"middle_ns": 2_500_000_000, "quaternion": attitude, "matched": 5, "status": "solved"}),
        (1.7, {"quaternion": [math.nan] * 4, "status": "no-match"}),
    ]  # fmt: skip
    found = signals.star_attitudes(packed_run(truth=truth, stars=frames))
    assert {key: value for key, value in found.items() if key not in {"rms_error", "normalised"}} == {
        "frames": 3, "solved": 2, "tracked": 1, "accepted": 1, "matched": 7.0, "compared": 1,
        "status": {"solved": 2, "no-match": 1},
    }  # fmt: skip
    np.testing.assert_allclose(found["rms_error"], [0.0, 0.0, 0.003], atol=1e-6)
    assert found["normalised"] == pytest.approx(1.0 / 3.0, rel=1e-3)


def test_the_true_misalignment_of_the_camera_is_not_an_error_of_its_frames() -> None:
    """The rate of a frame is compared in camera axes, so the misalignment of the camera causes no error."""
    tilt, body = np.array([2e-3, -1e-3, 3e-3]), from_rotation_vector(np.array([0.2, -0.7, 0.4]))
    camera, rate = from_rotation_vector(tilt), np.array([0.1, 0.2, -0.05])
    truth = [(float(t), {"quaternion": body.tolist(), "rate": rate.tolist()}) for t in range(4)]
    small = [1e-12] * 3 + [0.0] * 3
    star = {"middle_ns": 1_500_000_000, "quaternion": multiply(camera, body).tolist(), "covariance": small}
    streak = {"exposure_start_ns": 1_000_000_000, "exposure": 1.0, "status": "rate",
              "rate": (attitude_matrix(camera) @ rate).tolist(), "covariance": small}  # fmt: skip
    run = packed_run(
        truth=truth,
        true_description=[(0.0, {"camera": tilt.tolist()})],
        stars=[(1.5, star)],
        streak=[(2.0, streak)],
    )
    np.testing.assert_allclose(signals.star_attitudes(run)["rms_error"], 0.0, atol=1e-6)
    np.testing.assert_allclose(signals.streaks(run)["rms_error"], 0.0, atol=1e-6)


def test_a_failed_frame_gave_neither_a_rate_nor_an_attitude() -> None:
    none = {"rate": [math.nan] * 3, "status": "too-few"}
    lost = {"quaternion": [math.nan] * 4, "status": "no-match"}
    run = packed_run(
        streak=[(k, {**none, "sequence": k, "exposure_start_ns": k * 1_000_000_000}) for k in (1, 2, 3)]
        + [(4, {"sequence": 4, "status": "rate"})],
        stars=[(1, {**lost, "sequence": 1}), (2, {"sequence": 2, "status": "solved"})],
    )
    assert signals.failed_frames(run) == [
        {"sequence": 1, "exposed_s": 1.0, "streaks": "too-few", "stars": "no-match"},
        {"sequence": 3, "exposed_s": 3.0, "streaks": "too-few", "stars": None},
    ]


def test_the_errors_of_the_estimate_are_about_the_thread() -> None:
    def at(angle: float) -> list[float]:
        return [0.0, math.sin(0.5 * angle), 0.0, math.cos(0.5 * angle)]

    truth = [
        (0.0, {"quaternion": at(3.1), "rate": [9.0, 0.2, 9.0]}),
        (1.0, {"quaternion": at(3.3), "rate": [0.0, 0.2, 0.0]}),
    ]
    control = [
        (0.0, {"angle": 3.13, "rate": 0.24, "angle_sigma": 0.03, "rate_sigma": 0.02}),
        (1.0, {"angle": 3.34 - 2 * math.pi, "rate": 0.17, "angle_sigma": 0.02, "rate_sigma": 0.0}),
        (0.5, {"angle": math.nan}),
        (2.0, {"angle": 9.0, "rate": 9.0, "angle_sigma": 0.1, "rate_sigma": 0.1}),  # after the truth log
    ]
    found = signals.estimate_errors(packed_run(truth=truth, control=control))
    assert found is not None
    assert found["angle_rms_rad"] == pytest.approx(math.sqrt((0.03**2 + 0.04**2) / 2))
    assert found["rate_rms_rad_s"] == pytest.approx(math.sqrt((0.04**2 + 0.03**2) / 2))
    assert found["angle_normalised"] == pytest.approx(math.sqrt((1.0 + 4.0) / 2))
    assert found["rate_normalised"] == pytest.approx(2.0)
    assert signals.estimate_errors(packed_run(truth=truth[:1], control=control)) is None
