"""Tests of the diagnosis of axes and coils with inexact rotations by hand, noise, and random axis swaps.

The limits of the diagnosis are tested with values of 5 to 20 % below and above each limit. Tests with exact
rotations and fields calculate the expected numbers by hand.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from ground.bringup.diagnosis import (
    GRAVITY,
    AxesFound,
    CoilsFound,
    CoilTest,
    Finding,
    Samples,
    Turns,
    UnitExpectation,
    allan_deviation,
    axis_names,
    diagnose_axes,
    diagnose_coils,
    diagnose_rest,
    missing_share,
    noise_of,
    signed_permutations,
    turned,
)
from ground.bringup.session import _mounting
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector

SENSORS = ("gyro", "accelerometer", "magnetometer")


def rotation(vector: FloatArray) -> FloatArray:
    return attitude_matrix(from_rotation_vector(vector))


def by_hand(generator: np.random.Generator, axes: dict[str, FloatArray]) -> Turns:
    """Return rotations by hand with random errors of the axis (6 deg rms) and of the angle (8 deg rms)."""
    field, up, bias = (
        np.array([1.9e-5, 0.0, -4.2e-5]),
        np.array([0.0, 0.0, GRAVITY]),
        generator.normal(size=3),
    )
    gyro, before, after = np.zeros((3, 3)), np.zeros((3, 2, 3)), np.zeros((3, 2, 3))
    for index in range(3):
        stand = rotation(np.radians([3.0, 3.0, 5.0]) * generator.normal(size=3))
        about = np.eye(3)[index] + np.radians(6.0) * generator.normal(size=3)
        vector = about / np.linalg.norm(about) * np.radians(90.0 + 8.0 * generator.normal())
        gyro[index] = axes["gyro"] @ vector
        for place, to_body in ((before, stand), (after, rotation(vector) @ stand)):
            place[index, 0] = axes["accelerometer"] @ to_body @ up
            place[index, 1] = axes["magnetometer"] @ to_body @ field + 3e-6 * bias
    return Turns(gyro, before, after)


@pytest.mark.parametrize("wrong", [(), SENSORS, *((name,) for name in SENSORS)])
def test_axes_are_found_in_turns_by_hand(wrong: tuple[str, ...]) -> None:
    generator = np.random.default_rng(37)
    for drawn in generator.integers(1, 48, 4):
        matrix = signed_permutations()[int(drawn)]
        axes = {name: matrix if name in wrong else np.eye(3) for name in SENSORS}
        found = diagnose_axes(by_hand(generator, axes))
        assert found.gyro is not None
        assert found.accelerometer is not None
        assert found.magnetometer is not None
        assert np.array_equal(found.gyro, axes["gyro"])
        assert np.array_equal(found.accelerometer, axes["accelerometer"])
        assert np.array_equal(found.magnetometer, axes["magnetometer"]) or np.array_equal(
            found.magnetometer, -axes["magnetometer"]
        ), "a turn leaves the sign of the magnetometer open"
        if not wrong:
            assert not found.findings


@pytest.mark.parametrize("size_known", [True, False])
def test_exchanged_and_reversed_coils_are_found(size_known: bool) -> None:
    generator = np.random.default_rng(38)
    for _ in range(50):
        expected = 5e-4 * np.eye(3) + 5e-5 * generator.normal(size=(3, 3))
        order, signs = generator.permutation(3), generator.choice([1.0, -1.0], 3)
        plus = expected[order] * signs[:, None] * (1.0 + 0.03 * generator.normal(size=(3, 1)))
        minus = plus + 1e-7 * generator.normal(size=(3, 3))
        current = 0.15 * (1.0 + 0.02 * generator.normal(size=(3, 2)))
        test = CoilTest(np.full(3, 0.15), plus, minus, current, 0.0, 1e-7, np.zeros((3, 2)))
        found = diagnose_coils(test, expected, "xyz", size_known=size_known)
        # The diagnosis reports a fault of the magnetometer, not of the three coils.
        common = -1.0 if (signs < 0).all() else 1.0
        assert found.serves == order.tolist()
        assert np.array_equal(np.sign(found.strength), common * signs)


@pytest.mark.parametrize(
    ("axes", "kind", "changed"),
    [
        (np.diag([-1.0, -1.0, 1.0]), "rotated", True),
        (np.roll(np.eye(3), 1, axis=0), "rotated", True),
        (np.eye(3), "wrong scale", False),
        (None, "rotated", False),
    ],
)
def test_only_a_rotated_unit_changes_the_mounting_which_then_gives_body_axes(
    axes: FloatArray | None, kind: str, changed: bool
) -> None:
    mounting = from_rotation_vector(np.array([0.3, -0.2, 0.1]))
    config: Any = Mock(inertial_unit=Mock(mounting=mounting.tolist()))
    found = _mounting(config, axes, [Finding("inertial_unit", kind, "", "")])
    assert set(found) == ({"inertial_unit"} if changed else set())
    if axes is not None and changed:
        corrected = attitude_matrix(np.array(found["inertial_unit"]["mounting"]))
        assert axes @ corrected == pytest.approx(attitude_matrix(mounting), abs=1e-7)


def named(findings: list[Finding]) -> list[str]:
    """Return the part and the kind of each finding, as one text."""
    return [f"{one.part} {one.kind}" for one in findings]


def test_a_finding_is_one_line_of_part_kind_text_and_cure() -> None:
    assert Finding("coils", "no field", "nothing", "look").line() == "coils: no field: nothing: look"


def test_the_signed_permutations_are_all_orthogonal_matrices_of_zeros_and_ones() -> None:
    found = signed_permutations()
    assert len({tuple(matrix.ravel()) for matrix in found}) == len(found) == 48
    assert np.array_equal(found[0], np.eye(3))
    assert all(np.array_equal(matrix @ matrix.T, np.eye(3)) for matrix in found)
    assert sum(np.linalg.det(matrix) > 0 for matrix in found) == 24


def test_only_wrong_axes_are_named_with_sign() -> None:
    matrix = np.array([[0.0, -1.0, 0.0], [0.9, 0.0, 0.1], [0.0, 0.0, -1.0]])
    assert axis_names(matrix) == "x shows -y, y shows x, z shows -z"
    assert axis_names(np.diag([1.0, -1.0, 1.0])) == "y shows -y"
    assert not axis_names(np.eye(3))


def test_the_noise_of_each_axis_excludes_a_slow_drift() -> None:
    drift = np.linspace(0.0, 50.0, 4000)[:, None]
    values = drift + np.array([1.0, 2.0, 5.0]) * np.random.default_rng(1).normal(size=(4000, 3))
    assert noise_of(values) == pytest.approx([1.0, 2.0, 5.0], rel=0.05)


@pytest.mark.parametrize(("weak", "expected"), [(0.0, 0.3), (0.45, 0.3), (0.55, 0.0), (-1.0, 0.3)])
def test_a_sample_lacks_the_field_below_half_of_the_usual_change(weak: float, expected: float) -> None:
    change = np.outer(np.where(np.arange(100) % 10 < 3, weak, 1.0), [1e-5, -2e-5, 2e-5])
    assert missing_share(change, 1e-7) == pytest.approx(expected)


@pytest.mark.parametrize(("noise", "expected"), [(3.6e-6, 0.3), (3.9e-6, 0.0)])
def test_no_field_is_missing_if_the_usual_change_is_below_eight_sigma(noise: float, expected: float) -> None:
    change = np.outer(np.arange(100) % 10 >= 3, [1e-5, -2e-5, 2e-5])  # 3e-5 T
    assert missing_share(change, noise) == pytest.approx(expected)
    assert missing_share(np.zeros((100, 3)), 1e-7) == 0.0


def test_the_allan_deviation_of_a_ramp_is_its_change_in_the_averaging_time_over_root_two() -> None:
    slopes = np.array([1.0, -3.0, 0.5])
    times, found = allan_deviation(np.arange(70)[:, None] * 0.1 * slopes, 0.1)
    assert times == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6])  # averaging times up to a quarter of the record
    assert found == pytest.approx(times[:, None] * np.abs(slopes) / math.sqrt(2.0))


def test_the_allan_deviation_of_white_noise_falls_with_the_root_of_the_time() -> None:
    times, found = allan_deviation(np.random.default_rng(3).normal(size=(20000, 3)), 1.0)
    assert found[:6] == pytest.approx(np.repeat(times[:6, None] ** -0.5, 3, axis=1), rel=0.1)


EXPECTED = UnitExpectation(40.0, 1e-3, 1e-7, 0.01)


def resting(count: int = 400, *, rate_hz: float = 40.0, **changes: FloatArray) -> Samples:
    """Return samples of a healthy unit at rest with the expected noise, or with other values."""
    noise = np.random.default_rng(5).normal(size=(3, count, 3))
    values = {
        "times": np.arange(count) / rate_hz,
        "rate": 1e-3 * noise[0],
        "field": np.array([2e-5, 0.0, -3e-5]) + 1e-7 * noise[1],
        "acceleration": np.array([0.0, 0.0, GRAVITY]) + 0.01 * noise[2],
    }
    return Samples(**values | changes)


def of_rest(samples: Samples, *, bad: float = 0.0, span: float = 10.0) -> list[Finding]:
    return diagnose_rest(samples, span, EXPECTED, bad, 7.5e-5)


@pytest.mark.parametrize(
    ("samples", "bad", "kinds", "says"),
    [
        (resting(), 0.01, [], ""),
        (resting(400), 0.011, ["corrupted packets"], "1.1 % of the packets"),
        (resting(200, rate_hz=20.0), 0.5, ["corrupted packets"], "50.0 % of the packets"),
        (resting(200, rate_hz=20.0), 0.0, ["wrong rate"], "20.0 valid samples per second"),
        (resting(4, rate_hz=0.4), 0.995, ["corrupted packets"], "99.5 % of the packets"),
        (resting(418), 0.0, [], ""),
        (resting(422), 0.0, ["wrong rate"], "42.2 valid"),
        (resting(382), 0.0, [], ""),
        (resting(378), 0.0, ["wrong rate"], "37.8 valid"),
    ],
)  # fmt: skip
def test_the_rate_of_samples_and_of_wrong_packets_is_checked(
    samples: Samples, bad: float, kinds: list[str], says: str
) -> None:
    found = of_rest(samples, bad=bad)
    assert named(found) == [f"inertial_unit {kind}" for kind in kinds]
    assert all(says in one.text for one in found)


@pytest.mark.parametrize(
    ("pauses", "bad", "kinds", "says"),
    [
        ((0.09,), 0.0, [], ""),
        ((0.11,), 0.0, ["intermittent"], "stop 1 times, for up to 0.11 s"),
        ((0.3, 0.18), 0.0, ["intermittent"], "stop 2 times, for up to 0.30 s"),
        ((0.3, 0.12), 0.0, ["intermittent"], "stop 1 times, for up to 0.30 s"),
        ((0.3,), 0.02, ["corrupted packets"], "2.0 %"),
    ],
)
def test_pauses_of_four_periods_are_loose_contacts(
    pauses: tuple[float, ...], bad: float, kinds: list[str], says: str
) -> None:
    steps = np.full(400, 0.025)
    steps[[100, 200][: len(pauses)]] = pauses
    found = of_rest(resting(times=np.cumsum(steps)), bad=bad)
    assert named(found) == [f"inertial_unit {kind}" for kind in kinds]
    assert all(says in one.text for one in found)


def test_sensors_are_judged_from_twenty_samples_on() -> None:
    stuck = np.zeros((20, 3))
    few = resting(19, rate=stuck[:19])
    assert named(of_rest(few, span=19 / 40)) == []
    assert named(of_rest(resting(20, rate=stuck), span=0.5)) == ["inertial_unit.gyro stuck"]


def _repeating(every: int) -> FloatArray:
    """Return healthy rates (400, 3) of which every n-th repeats its predecessor."""
    number = np.arange(400)
    return resting().rate[np.maximum.accumulate(np.where(number % every == 0, 0, number))]


def _one_axis(name: str, axis: int, factor: float) -> Samples:
    """Return samples whose noise on one axis of a sensor is multiplied by a factor."""
    samples = resting()
    values = getattr(samples, name).copy()
    values[:, axis] = values[:, axis].mean() + factor * (values[:, axis] - values[:, axis].mean())
    return replace(samples, **{name: values})


@pytest.mark.parametrize(
    ("samples", "expected", "says"),
    [
        (_one_axis("rate", 1, 2.7), [], ""),
        (_one_axis("rate", 1, 3.4), ["gyro noisy"], " rad/s on y, expected 0.001"),
        (_one_axis("field", 0, 3.4), ["magnetometer noisy"], " T on x, expected 1e-07"),
        (_one_axis("acceleration", 2, 3.4), ["accelerometer noisy"], " m/s^2 on z, expected 0.01"),
        (_one_axis("rate", 2, 1.3e-3), [], ""),
        (_one_axis("rate", 2, 0.7e-3), ["gyro stuck"], "values on z do not change: noise"),
        (resting(rate=np.zeros((400, 3))), ["gyro stuck"], "values on x, y, z do not change: noise 0.0e+00"),
        (resting(rate=np.full((400, 3), math.nan)), ["gyro dead"], "not numbers"),
        (resting(rate=np.repeat(resting().rate[:200], 2, axis=0)), ["gyro wrong rate"],
         "50 % of its values repeat: 19.9 are new per second"),
        (resting(rate=_repeating(6)), [], ""),
        (resting(rate=_repeating(4)), ["gyro wrong rate"], "25 % of its values repeat: 30.1 are new"),
    ],
)  # fmt: skip
def test_noise_of_a_sensor_is_compared_with_its_data_sheet(
    samples: Samples, expected: list[str], says: str
) -> None:
    found = of_rest(samples)
    assert named(found) == [f"inertial_unit.{kind}" for kind in expected]
    assert all(says in one.text for one in found)


def _moved(name: str, offset: list[float], factor: float = 1.0) -> Samples:
    samples = resting()
    return replace(samples, **{name: factor * getattr(samples, name) + np.array(offset)})


@pytest.mark.parametrize(
    ("samples", "expected", "says"),
    [
        (_moved("rate", [0.0, 0.0195, 0.0]), [], ""),
        (_moved("rate", [0.0, -0.0205, 0.0]), ["gyro biased"], "0.020 rad/s at rest"),
        (_moved("rate", [0.01, 0.0, -0.03]), ["gyro biased"], "0.030 rad/s at rest"),
        (_moved("acceleration", [0.0] * 3, 1.045), [], ""),
        (_moved("acceleration", [0.0] * 3, 1.055),
         ["accelerometer wrong scale"], "10.35 m/s^2 at rest instead of 9.81"),
        (_moved("acceleration", [0.0] * 3, 0.945), ["accelerometer wrong scale"], "9.27 m/s^2"),
        (_moved("field", [0.0] * 3, 15.5 / 36.06), [], ""),
        (_moved("field", [0.0] * 3, 14.5 / 36.06),
         ["magnetometer wrong scale"], "14.5 uT at rest, expected are 15 to 75 uT"),
        (_moved("field", [0.0] * 3, 74.5 / 36.06), [], ""),
        (_moved("field", [0.0] * 3, 75.5 / 36.06), ["magnetometer wrong scale"], "75.5 uT"),
    ],
)  # fmt: skip
def test_means_at_rest_are_those_of_a_body_that_stands_still_on_earth(
    samples: Samples, expected: list[str], says: str
) -> None:
    found = of_rest(samples)
    assert named(found) == [f"inertial_unit.{kind}" for kind in expected]
    assert all(says in one.text for one in found)


def test_a_rotation_is_the_integral_of_the_rate_less_its_bias() -> None:
    times = np.array([0.0, 0.1, 0.3, 0.4])
    rate = np.array([[9.0, 9.0, 9.0], [1.0, 0.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, -4.0]])
    found = turned(Samples(times, rate, rate, rate), np.array([0.5, 0.0, 0.0]))
    assert found == pytest.approx([0.1 * 0.5 + 0.2 * 1.5 - 0.1 * 0.5, 0.2, -0.4])


# Exact rotations.

SITE = np.array([1.9e-5, 0.0, -4.2e-5])


def exact(
    *,
    gyro: FloatArray | float = 1.0,
    accelerometer: FloatArray | float = 1.0,
    magnetometer: FloatArray | float = 1.0,
    bias: FloatArray | float = 0.0,
    site: FloatArray = SITE,
) -> Turns:
    """Return exact rotations, measured by sensors with wrong axes or scales, given as matrices or numbers."""
    matrices = [
        one * np.eye(3) if isinstance(one, float) else one for one in (gyro, accelerometer, magnetometer)
    ]
    up = np.array([0.0, 0.0, GRAVITY])
    before = np.array([[matrices[1] @ up, matrices[2] @ site + bias]] * 3)
    bodies = [rotation(0.5 * math.pi * axis) for axis in np.eye(3)]
    after = np.array([[matrices[1] @ body @ up, matrices[2] @ body @ site + bias] for body in bodies])
    return Turns(0.5 * math.pi * matrices[0].T, before, after)


def about(axis: int, degrees: float) -> FloatArray:
    """Return the matrix of a rotation about an axis."""
    return rotation(np.radians(degrees) * np.eye(3)[axis])


def with_rows(turns: Turns, sizes: list[float]) -> Turns:
    """Return a copy of rotations in which the gyro measured the given angles (deg)."""
    return replace(turns, gyro=np.diag(np.radians(sizes)))


PERMUTED = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("turns", "expected", "says"),
    [
        (exact(), [], ""),
        (exact(gyro=1.08), [], ""),
        (exact(gyro=1.12), ["gyro wrong scale"], "ratio of its angles to those from gravity: x 1.12, y 1.12"),
        (exact(gyro=0.88), ["gyro wrong scale"], "x 0.88, y 0.88"),
        (with_rows(exact(), [90.0, 105.0, 90.0]), ["gyro wrong scale"], "x 1.00, y 1.17"),
        (exact(gyro=1.4), ["gyro wrong scale"], "measured to requested angle: x 1.40, y 1.40, z 1.40"),
        (with_rows(exact(), [90.0, 90.0, 126.0]), ["gyro wrong scale"], "x 1.00, y 1.00, z 1.40"),
        (with_rows(exact(), [90.0, 90.0, 117.0]), [], ""),
        (with_rows(exact(), [90.0, 17.0, 90.0]), ["gyro dead"], "90 deg about y is measured as 17.0 deg"),
        (with_rows(exact(), [90.0, 19.0, 90.0]), ["gyro wrong scale"], "y 0.21"),
        (replace(exact(), gyro=np.full((3, 3), math.nan)), ["gyro dead"], "not numbers"),
        (exact(gyro=PERMUTED), ["gyro rotated"], "x shows y, y shows z, z shows x"),
        (exact(gyro=np.diag([1.0, 1.0, -1.0])), ["gyro mirrored"], "z shows -z"),
        (exact(gyro=about(0, 20.0), accelerometer=about(0, 20.0)), [], ""),
        (exact(gyro=about(0, 30.0)), ["gyro rotated"], "rotated by 30 deg about (-1.00"),
        (exact(accelerometer=1.3), [], ""),
        (exact(accelerometer=np.diag([1.0, 0.5, 1.0])), ["accelerometer wrong scale"],
         "largest values to gravity: x 1.00, y 0.50, z 1.00"),
        (exact(accelerometer=0.05), ["accelerometer wrong axes"], "different from the configuration"),
        (exact(accelerometer=np.diag([1.0, -1.0, 1.0])), ["accelerometer mirrored"], "y shows -y"),
        (exact(magnetometer=about(2, 20.0)), [], ""),
        (exact(magnetometer=about(2, 30.0)), ["magnetometer rotated"], "rotated by 30 deg about"),
        (exact(magnetometer=np.diag([-1.0, -1.0, 1.0])), ["magnetometer mirrored"], "z shows -z"),
        (exact(magnetometer=-1.0), [], ""),
        (exact(magnetometer=np.diag([0.5, 1.0, 1.0])),
         ["magnetometer wrong scale"], "x 0.50, y 1.00, z 1.00"),
        (exact(bias=np.array([1e-5, -1e-5, 1e-5])), [], ""),
        (exact(bias=np.array([0.0, 2e-5, 0.0])), ["magnetometer biased"], "20 uT, the site's 46 uT"),
        (exact(bias=np.array([0.0, 1.7e-5, 0.0])), [], ""),
        (exact(bias=np.array([0.0, 1.4e-5, 0.0]), site=0.4 * SITE), [], ""),
        (exact(bias=np.array([0.0, 1.6e-5, 0.0]), site=0.4 * SITE),
         ["magnetometer biased"], "16 uT, the site's 18 uT"),
    ],
)  # fmt: skip
def test_exact_rotations_show_each_wrong_axis_and_scale(turns: Turns, expected: list[str], says: str) -> None:
    found = diagnose_axes(turns).findings
    assert named(found) == [f"inertial_unit.{one}" for one in expected]
    assert all(says in one.text for one in found)


@pytest.mark.parametrize(("index", "name"), [(0, "accelerometer"), (1, "magnetometer")])
@pytest.mark.parametrize(("share", "stuck"), [(0.0, True), (0.015, True), (0.03, False)])
def test_a_sensor_that_does_not_change_during_the_rotations_is_stuck(
    index: int, name: str, share: float, stuck: bool
) -> None:
    turns = exact()
    turns.after[:, index] = turns.before[:, index]
    turns.after[:, index, 0] += share * np.linalg.norm(turns.before[0, index])
    found = diagnose_axes(turns)
    assert (f"inertial_unit.{name} stuck" in named(found.findings)) == stuck
    assert getattr(found, name) is None
    assert found.gyro is not None
    assert np.array_equal(found.gyro, np.eye(3))


def same(found: AxesFound, matrix: FloatArray) -> bool:
    axes = found.gyro, found.accelerometer, found.magnetometer
    return all(one is not None and np.allclose(one, matrix, atol=1e-6) for one in axes)


@pytest.mark.parametrize(
    ("matrix", "kind", "says", "cure"),
    [
        (PERMUTED, "rotated", "all sensors are wrong: x shows y", "`mounting` as in the fragment"),
        (about(1, 40.0), "rotated", "rotated by 40 deg about (-0.00, -1.00", "set `mounting`"),
        (np.diag([1.0, -1.0, 1.0]), "mirrored", "y shows -y", "mirrored, which no mounting can cause"),
    ],
)  # fmt: skip
def test_equal_wrong_axes_of_all_sensors_are_one_finding(
    matrix: FloatArray, kind: str, says: str, cure: str
) -> None:
    found = diagnose_axes(exact(gyro=matrix, accelerometer=matrix, magnetometer=matrix))
    assert named(found.findings) == [f"inertial_unit {kind}"]
    assert says in found.findings[0].text
    assert cure in found.findings[0].cure
    assert same(found, matrix)


@pytest.mark.parametrize(("other", "common"), [(52.0, True), (58.0, False)])
def test_sensors_are_equally_mounted_up_to_15_deg(other: float, common: bool) -> None:
    turned_by = about(0, 40.0)
    found = diagnose_axes(exact(gyro=turned_by, accelerometer=about(0, other), magnetometer=turned_by))
    assert (named(found.findings) == ["inertial_unit rotated"]) == common
    assert same(found, turned_by) == common


def test_a_wrong_single_sensor_is_cured_by_its_own_axes() -> None:
    (found,) = diagnose_axes(exact(accelerometer=PERMUTED)).findings
    assert "sensors[].measures" in found.cure
    (found,) = diagnose_axes(exact(accelerometer=np.diag([1.0, -1.0, 1.0]))).findings
    assert "sensors[].measures" in found.cure


# Coils with exact fields.

FIELDS = 5e-4 * np.array([[1.0, 0.1, 0.0], [0.0, 1.1, -0.1], [0.1, 0.0, 0.9]])
COMMANDED = np.array([0.12, 0.15, 0.18])


def coils(
    *,
    field: Any = 1.0,
    drawn: Any = 1.0,
    axes: FloatArray | None = None,
    size_known: bool = True,
    **changes: Any,
) -> CoilsFound:
    """Return the diagnosis of a coil test whose fields and currents are multiples of the expected values.

    `field` and `drawn` are numbers for all coils or lists of numbers for each coil; `field` may also be a
    matrix (3, 3) that replaces the directions.
    """
    matrix = np.asarray(field, dtype=float)
    response = matrix @ FIELDS if matrix.ndim == 2 else np.reshape(matrix, (-1, 1)) * FIELDS
    current = np.repeat((COMMANDED * drawn)[:, None], 2, axis=1)
    sensor = np.eye(3) if axes is None else axes
    test = CoilTest(COMMANDED, response @ sensor.T, response @ sensor.T, current, 0.0, 1e-7, np.zeros((3, 2)))
    expected = FIELDS if size_known else FIELDS / np.linalg.norm(FIELDS, axis=1, keepdims=True)
    return diagnose_coils(replace(test, **changes), expected, "xyz", axes, size_known=size_known)


@pytest.mark.parametrize(
    ("changes", "expected", "says"),
    [
        ({}, [], ""),
        ({"field": -1.0}, ["inertial_unit.magnetometer reversed sign"], "fields of all 3 coils are opposite"),
        ({"idle": 0.0145}, [], ""),
        ({"idle": 0.0155}, ["coils current while off"], "delivers 16 mA with all coils at zero"),
        ({"idle": -0.0165}, ["coils current while off"], "delivers -16 mA"),
        ({"commanded": COMMANDED / 4, "drawn": 0.25, "idle": 0.0075}, [], ""),
        ({"commanded": COMMANDED / 4, "drawn": 0.25, "idle": 0.0085}, ["coils current while off"], ""),
        ({"volts": (5.0, 4.8)}, [], ""),
        ({"volts": (5.0, 4.7)}, ["coils sagging supply"], "falls from 5.00 to 4.70 V"),
        ({"field": 0.0, "drawn": 0.1}, ["coils no supply"], "3 coils makes a field or draws current"),
        ({"field": 0.0, "drawn": math.nan}, ["coils no field"], "none of the 3 coils makes a field"),
        ({"field": 0.0, "drawn": [0.1, 0.2, 0.1]}, ["inertial_unit.magnetometer no response"],
         "not change"),
        ({"sensed": False}, ["inertial_unit.magnetometer no response"], ""),
        ({"drawn": 0.025}, ["power_monitor no current"], "current stays zero"),
        ({"drawn": 0.035}, ["power_monitor wrong shunt"], "0.035 times"),
        ({"drawn": 1.13}, [], ""),
        ({"drawn": 1.25}, ["power_monitor wrong shunt"], "current is 1.25 times the commanded one"),
        ({"drawn": 1.25, "clipped": True}, ["power_monitor wrong shunt"], "current is at least 1.25 times"),
        ({"drawn": 0.8}, ["power_monitor wrong shunt"], "0.8 times"),
        ({"drawn": -1.0}, ["power_monitor reversed"], "-1 times"),
        ({"drawn": 1.3, "field": 1.3}, ["coils wrong supply voltage"], ", and so are the fields"),
        ({"drawn": 1.3, "size_known": False}, ["power_monitor wrong current"], "1.3 times"),
        ({"drawn": 2.8, "size_known": False}, ["power_monitor wrong current"], "2.8 times"),
        ({"drawn": 3.2, "size_known": False}, ["power_monitor wrong shunt"], "3.2 times"),
        ({"drawn": 0.35, "size_known": False}, ["power_monitor wrong current"], ""),
        ({"drawn": 0.25, "size_known": False}, ["power_monitor wrong shunt"], ""),
        ({"field": 3.0, "size_known": False}, [], ""),
        ({"drawn": math.nan}, [], ""),
    ],
)  # fmt: skip
def test_a_fault_that_all_coils_share_is_named_once(
    changes: dict[str, Any], expected: list[str], says: str
) -> None:
    found = coils(**changes).findings
    assert named(found) == expected
    assert all(says in one.text for one in found)


def test_a_current_that_differs_for_all_coils_is_divided_by_the_shunt_factor() -> None:
    found = coils(drawn=[2.0, 2.0, 1.0])
    assert named(found.findings) == ["power_monitor wrong shunt", "coils.windings[2] unlike"]
    assert found.shunt == pytest.approx(2.0)
    assert found.drawn == pytest.approx([1.0, 1.0, 0.5])
    assert coils(drawn=[2.0, 1.5, 1.0]).shunt == 1.0  # no common factor


def tilted(degrees: float) -> FloatArray:
    """Return a change of the fields that tilts the field of coil y by an angle."""
    unit = FIELDS[1] / np.linalg.norm(FIELDS[1])
    beside = np.cross(unit, [1.0, 0.0, 0.0])
    beside /= np.linalg.norm(beside)
    new = math.cos(math.radians(degrees)) * unit + math.sin(math.radians(degrees)) * beside
    fields = FIELDS.copy()
    fields[1] = np.linalg.norm(FIELDS[1]) * new
    return np.asarray(fields @ np.linalg.inv(FIELDS))


ASKEW_AXES = about(2, 30.0)


@pytest.mark.parametrize(
    ("changes", "kind", "says"),
    [
        ({"field": [1.0, 0.0, 1.0], "drawn": [1.0, 0.1, 1.0]}, "open", "coil y: no field and no current"),
        ({"field": [1.0, 0.1, 1.0], "drawn": [1.0, 0.1, 1.0]}, "open", ""),
        ({"field": [1.0, 0.0, 1.0], "drawn": [1.0, 0.2, 1.0]}, "current without field", "but 0.20 times"),
        ({"field": [1.0, 0.0, 1.0], "drawn": [1.0, 1.1, 1.0]}, "current without field", "1.10 times"),
        ({"field": [1.0, 0.0, 1.0], "drawn": [1.0, 1.3, 1.0]}, "short", "no field, but 1.30 times"),
        ({"field": [1.0, 0.0, 1.0], "drawn": math.nan}, "no field", "coil y: its field does not change"),
        ({"field": [1.0, 0.13, 1.0], "drawn": [1.0, 0.13, 1.0]}, "wrong resistance", "field 0.13 times"),
        ({"field": [1.0, 0.11, 1.0], "drawn": [1.0, 0.13, 1.0]}, "current without field", ""),
        ({"field": [1.0, 0.15, 1.0], "drawn": [1.0, 0.15, 1.0], "noise": 1.3e-5}, "wrong resistance", ""),
        ({"field": [1.0, 0.15, 1.0], "drawn": [1.0, 0.15, 1.0], "noise": 1.5e-5},
         "current without field", ""),
        ({"field": [1.0, -1.0, 1.0]}, "reversed", "coil y: its field is opposite"),
        ({"field": tilted(14.0)}, None, ""),
        ({"field": tilted(16.0)}, "wrong direction", "16 deg off the expected direction, along (0.00, "),
        ({"field": tilted(24.0), "axes": ASKEW_AXES}, None, ""),
        ({"field": tilted(26.0), "axes": ASKEW_AXES}, "wrong direction", "26 deg off"),
        ({"absent": np.array([[0.0, 0.0], [0.0, 0.035], [0.0, 0.0]])}, None, ""),
        ({"absent": np.array([[0.0, 0.0], [0.0, 0.05], [0.0, 0.0]])}, "intermittent", "missing in 5 % of"),
        ({"field": [1.0, 0.82, 1.0]}, None, ""),
        ({"field": [1.0, 0.78, 1.0]}, "wrong strength", "field 0.78 times the expected one"),
        ({"field": [1.0, 1.18, 1.0]}, None, ""),
        ({"field": [1.0, 1.22, 1.0]}, "wrong strength", "field 1.22 times"),
        ({"field": [1.0, 0.5, 1.0], "drawn": math.nan}, "wrong strength", "field 0.50 times"),
        ({"drawn": [1.0, 0.82, 1.0]}, None, ""),
        ({"drawn": [1.0, 0.78, 1.0]}, "unlike", "field 1.00 times the expected one, current 0.78 times"),
        ({"drawn": [1.0, 1.28, 1.0]}, "unlike", "current 1.28 times"),
        ({"drawn": [1.0, 1.35, 1.0]}, "short", "current 1.35 times"),
        ({"field": [1.0, 0.7, 1.0], "drawn": [1.0, 0.7, 1.0]}, "wrong resistance", "current 0.70 times"),
        ({"field": [1.0, 0.5, 1.0], "drawn": [1.0, 0.56, 1.0]}, "wrong resistance", "field 0.50 times"),
        ({"field": [1.0, 0.5, 1.0], "drawn": [1.0, 0.6, 1.0]}, "unlike", "current 0.60 times"),
    ],
)  # fmt: skip
def test_a_fault_of_one_coil_is_named_and_no_other(
    changes: dict[str, Any], kind: str | None, says: str
) -> None:
    found = coils(**changes).findings
    assert named(found) == ([] if kind is None else [f"coils.windings[1] {kind}"])
    assert all(says in one.text for one in found)


def test_the_resistance_is_multiplied_by_the_ratio_of_commanded_to_measured_current() -> None:
    (found,) = coils(field=[1.0, 0.8, 1.0], drawn=[1.0, 0.75, 1.0]).findings
    assert found.factor == pytest.approx(4.0 / 3.0)
    assert found.cure == "multiply `resistance` by 1.33"


@pytest.mark.parametrize(
    ("way", "left", "kind", "says"),
    [
        ("plus", 0.2, "half bridge", "coil y: a positive current makes no field"),
        ("minus", 0.2, "half bridge", "coil y: a negative current makes no field"),
        ("plus", 0.3, "wrong strength", "coil y: field 0.65 times"),
    ],
)
def test_a_coil_with_one_direction_of_current_has_half_a_bridge(
    way: str, left: float, kind: str, says: str
) -> None:
    weak = FIELDS * np.array([[1.0], [left], [1.0]])
    (found,) = coils(**{way: weak}).findings
    assert (found.kind, found.part) == (kind, "coils.windings[1]")
    assert says in found.text
    assert ("check input A" in found.cure) == (kind == "half bridge" and way == "plus")
    assert ("check input B" in found.cure) == (kind == "half bridge" and way == "minus")


@pytest.mark.parametrize(
    ("drawn", "says", "cure"),
    [
        (1.6, "drives coils x and y with 1.60 times the commanded current", "connected in parallel, "),
        (1.0, "drives coils x and y with 1.00 times the commanded current", "which are connected and"),
        (0.6, "drives coils x and y with 0.60 times the commanded current", "connected in series, "),
        (math.nan, "the command of coil x drives coils x and y", "which are connected and"),
    ],
)
def test_two_coils_on_one_bridge_are_named_by_their_current(drawn: float, says: str, cure: str) -> None:
    both = np.array([[1.0, 0.5, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    found = coils(field=both, drawn=[drawn, 0.0, 1.0])
    assert named(found.findings) == ["coils.windings[0] several coils", "coils.windings[1] open"]
    assert found.joined == {0: 1}
    assert says in found.findings[0].text
    assert cure in found.findings[0].cure


@pytest.mark.parametrize(("apart", "error"), [(0.0, 0.0), (20.0, 6.0)])
def test_healthy_coils_with_nearly_parallel_fields_are_not_reported_as_connected(
    apart: float, error: float
) -> None:
    def fields(third: float, fourth: float) -> FloatArray:
        """Return the fields of coils along x, along y, and at two angles (deg) from z towards y."""
        angles = np.radians([90.0, third, fourth])
        rows = np.stack([np.zeros(3), np.sin(angles), np.cos(angles)], axis=1)
        return 1e-4 * np.vstack([[1.0, 0.0, 0.0], rows])

    measured, current = fields(error, apart - error), np.full((4, 2), 0.1)
    test = CoilTest(np.full(4, 0.1), measured, measured, current, 0.0, 1e-7, np.zeros((4, 2)))
    found = diagnose_coils(test, fields(0.0, apart), "xyzw")
    assert found.findings == []
    assert found.joined == {}


def test_the_result_states_coil_strength_and_angle_of_each_command() -> None:
    swapped = np.array([[0.0, -0.9, 0.0], [1.1, 0.0, 0.0], [0.0, 0.0, 1.0]])
    found = coils(field=swapped)
    assert named(found.findings) == [f"coils.windings[{number}] exchanged" for number in (0, 1)]
    assert [one.text for one in found.findings] == [
        "the command of coil x drives coil y, reversed",
        "the command of coil y drives coil x",
    ]
    assert found.serves == [1, 0, 2]
    assert found.strength == pytest.approx([-0.9, 1.1, 1.0])
    assert found.misfit == pytest.approx([0.0] * 3, abs=1e-6)
    assert found.response == pytest.approx(swapped @ FIELDS)
    assert found.live.tolist() == [True] * 3
    silent = coils(field=[1.0, 0.0, 1.0], drawn=[1.0, 0.0, 1.0])
    assert silent.serves == [0, -1, 2]
    assert silent.strength == pytest.approx([1.0, 0.0, 1.0])
    assert silent.misfit == pytest.approx([0.0, math.pi, 0.0], abs=1e-6)
    assert silent.live.tolist() == [True, False, True]


def test_relative_strengths_refer_to_the_median_field_if_the_strength_is_unknown() -> None:
    found = coils(field=[2.0, 2.0, 1.0], size_known=False)
    sizes = np.linalg.norm(FIELDS, axis=1) * [2.0, 2.0, 1.0]
    assert found.strength == pytest.approx(sizes / np.median(sizes))
    assert named(found.findings) == ["coils.windings[2] wrong strength"]
    # A coil without a field is not included in the median.
    silent = coils(field=[2.0, 0.0, 1.2], drawn=[1.0, 0.0, 1.0], size_known=False)
    sizes = np.linalg.norm(FIELDS, axis=1) * [2.0, 0.0, 1.2]
    assert silent.strength == pytest.approx(sizes / np.mean(sizes[[0, 2]]))
