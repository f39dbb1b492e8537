"""Tests of messages and noise of the emulated VN-100, by VectorNav UM001 v2.43, ch. 4 and 5."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hal.drivers.vn100_protocol import FIELDS
from knightcube.astro.quaternion import IDENTITY, attitude_matrix, from_rotation_vector, multiply
from sim_hal.emulators.vn100 import SUPPORTED_FIELDS
from sim_hal.emulators.vn100_sensors import (
    BINARY_FIELDS,
    OUTPUT_BY_REGISTER,
    OUTPUT_BY_TYPE,
    PROFILES,
    REPORTS,
    MessageData,
    NoiseProfile,
    Sensors,
    Vn100Sample,
    readers,
)
from sim_hal.worlds.world import BodyMotion

MANUAL = {
    1: ("YPR", 8, 3),
    2: ("QTN", 9, 4),
    8: ("QMR", 15, 13),
    9: ("DCM", None, 9),
    10: ("MAG", 17, 3),
    11: ("ACC", 18, 3),
    12: ("GYR", 19, 3),
    13: ("MAR", 20, 9),
    14: ("YMR", 27, 12),
    16: ("YBA", 239, 9),
    17: ("YIA", 240, 9),
    19: ("IMU", 54, 11),
    30: ("DTV", 80, 7),
}
"""Output types of register 6 [UM001]: header, register with the same content, and number of values."""

YAW, PITCH, ROLL = 0.7, -0.3, 0.2
MAG, ACCEL, RATE = (0.21, -0.05, 0.43), (0.5, -0.25, -9.7), (0.011, -0.022, 0.033)


def rotation(axis: int, angle: float) -> np.ndarray:
    """Return the matrix of a rotation of the axes by `angle` about one axis."""
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[i, j], matrix[j, i] = math.sin(angle), -math.sin(angle)
    return matrix


TURN = rotation(0, ROLL) @ rotation(1, PITCH) @ rotation(2, YAW)


def about(axis: int, angle: float) -> np.ndarray:
    """Return the quaternion of a rotation about an axis."""
    return from_rotation_vector(angle * np.eye(3)[axis])


def data(interval: float = 0.02) -> MessageData:
    """Return the data of a unit that is tilted and moves."""
    attitude = multiply(about(0, ROLL), multiply(about(1, PITCH), about(2, YAW)))
    sample = Vn100Sample(attitude, np.array(RATE), np.array(MAG), np.array(ACCEL))
    return MessageData(123_456_789, sample, 0x0A5, interval, 21.5, 99.25)


def test_the_tilted_unit_has_the_matrix_of_its_three_angles() -> None:
    np.testing.assert_allclose(data().sample.matrix, TURN, atol=1e-12)
    angles = [math.degrees(angle) for angle in (YAW, PITCH, ROLL)]
    np.testing.assert_allclose(data().sample.yaw_pitch_roll, angles, atol=1e-9)


def test_every_ascii_output_has_the_number_and_register_of_the_manual() -> None:
    found = {
        output.async_type: (output.header, output.register, len(data().text(output.quantities)))
        for output in REPORTS
    }
    assert found == MANUAL
    assert OUTPUT_BY_TYPE.keys() == MANUAL.keys()
    assert {number: output.header for number, output in OUTPUT_BY_REGISTER.items()} == {
        register: header for header, register, _ in MANUAL.values() if register is not None
    }


CONTENT: dict[str, list[float]] = {
    "YPR": [math.degrees(angle) for angle in (YAW, PITCH, ROLL)],
    "DCM": TURN.flatten().tolist(),
    "MAG": list(MAG),
    "ACC": list(ACCEL),
    "GYR": list(RATE),
    "MAR": [*MAG, *ACCEL, *RATE],
    "YMR": [*(math.degrees(angle) for angle in (YAW, PITCH, ROLL)), *MAG, *ACCEL, *RATE],
    "YBA": [
        *(math.degrees(angle) for angle in (YAW, PITCH, ROLL)),
        *(np.array(ACCEL) + TURN @ [0.0, 0.0, 9.80665]),
        *RATE,
    ],
    "YIA": [
        *(math.degrees(angle) for angle in (YAW, PITCH, ROLL)),
        *(TURN.T @ ACCEL + [0.0, 0.0, 9.80665]),
        *RATE,
    ],
    "IMU": [*MAG, *ACCEL, *RATE, 21.5, 99.25],
    "DTV": [0.02, *(math.degrees(rate) * 0.02 for rate in RATE), *(part * 0.02 for part in ACCEL)],
}


@pytest.mark.parametrize("header", CONTENT)
def test_an_ascii_output_has_the_values_of_the_manual(header: str) -> None:
    (output,) = (output for output in REPORTS if output.header == header)
    values = [float(text) for text in data().text(output.quantities)]
    np.testing.assert_allclose(values, CONTENT[header], atol=6e-4)


@pytest.mark.parametrize(("header", "length"), [("YMR", 122), ("QMR", 135), ("YPR", 38), ("QTN", 51)])
def test_a_sentence_has_the_length_that_its_formats_give(header: str, length: int) -> None:
    """The length of a sentence follows from the formats of its values.

    `$VNxxx` has 6 bytes, `*XX` and the line end have 5 bytes, and a value has its width plus a comma. The
    widths are 8 (angles, field), 9 (quaternion), 7 (acceleration) and 10 (rate).
    """
    (output,) = (output for output in REPORTS if output.header == header)
    assert output.length() == length


def test_the_binary_fields_are_those_that_the_unit_supports() -> None:
    supported = {
        (group, bit) for group, word in SUPPORTED_FIELDS.items() for bit in range(16) if word >> bit & 1
    }
    assert set(BINARY_FIELDS) == supported


EXPECTED: dict[str, list[float]] = {
    "time_startup": [123_456_789],
    "sync_in_count": [0],
    "sync_out_count": [0],
    "time_sync_in": [0],
    "yaw_pitch_roll": [math.degrees(angle) for angle in (YAW, PITCH, ROLL)],
    "angular_rate": list(RATE),
    "uncomp_gyro": list(RATE),
    "accel": list(ACCEL),
    "uncomp_accel": list(ACCEL),
    "imu": [*ACCEL, *RATE],
    "mag": list(MAG),
    "uncomp_mag": list(MAG),
    "mag_pres": [*MAG, 21.5, 99.25],
    "delta_theta_vel": [0.02, *(math.degrees(rate) * 0.02 for rate in RATE), *(a * 0.02 for a in ACCEL)],
    "delta_theta": [0.02, *(math.degrees(rate) * 0.02 for rate in RATE)],
    "delta_vel": [part * 0.02 for part in ACCEL],
    "status": [0x0A5],
    "vpe_status": [0x0A5],
    "imu_status": [0],
    "sens_sat": [0],
    "temp": [21.5],
    "pres": [99.25],
    "dcm": TURN.flatten(order="F").tolist(),
    "mag_ned": (TURN.T @ MAG).tolist(),
    "accel_ned": (TURN.T @ ACCEL).tolist(),
    "linear_accel_body": (np.array(ACCEL) + TURN @ [0.0, 0.0, 9.80665]).tolist(),
    "linear_accel_ned": (TURN.T @ ACCEL + [0.0, 0.0, 9.80665]).tolist(),
}


@pytest.mark.parametrize("key", sorted(BINARY_FIELDS))
def test_a_binary_field_has_the_quantity_of_its_name(key: tuple[int, int]) -> None:
    group, bit = key
    name, code = FIELDS[group][bit]
    values = tuple(value for read in readers([key]) for value in read(data()))
    assert len(values) == (int(code[:-1]) if code[:-1] else 1)
    if name == "quaternion":
        np.testing.assert_allclose(attitude_matrix(np.array(values)), TURN, atol=1e-12)
    elif name == "ypr_uncertainty":
        assert values == (2.0, 0.5, 0.5)  # UM001 Table 1: heading 2 deg, pitch and roll 0.5 deg
    else:
        np.testing.assert_allclose(values, EXPECTED[name], atol=1e-9)


def test_the_profiles_have_the_figures_of_thesis_and_data_sheet() -> None:
    """The noise profiles have the values of the thesis and the data sheet.

    The noise is 0.0035 deg/s, 140 uG and 0.14 mg per sqrt(Hz). The angle errors are 0.5, 0.5 and 2 deg rms.
    """
    thesis, sheet, none = PROFILES["thesis"], PROFILES["datasheet"], PROFILES["none"]
    assert (thesis.attitude_bound, thesis.rate_bound) == (1.75e-3, 1.75e-4)
    assert (sheet.attitude_bound, sheet.rate_bound, thesis.rate_density, thesis.gyro_bias) == (0, 0, 0, 0)
    assert none == NoiseProfile(0.0, 0.0, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), 0.0)
    for profile in (thesis, sheet):
        assert profile.field_density == pytest.approx(1.4e-8)
        assert profile.acceleration_density == pytest.approx(1.372931e-3)
    assert math.degrees(sheet.rate_density) == pytest.approx(0.0035)
    assert [math.degrees(angle) for angle in sheet.static_attitude] == pytest.approx([0.5, 0.5, 2.0])
    assert math.degrees(sheet.gyro_bias) * 3600.0 == pytest.approx(6.0)
    assert thesis.static_attitude == (0.0, 0.0, 0.0)


MOTION = BodyMotion(
    time_ns=0,
    quaternion=IDENTITY,
    rate=np.array([0.01, 0.02, 0.03]),
    field_body=np.array([2e-5, -3e-5, 4e-5]),
    specific_force_body=np.array([0.1, 0.2, -9.8]),
)


def sensors(
    profile: NoiseProfile, bias: tuple[float, ...] = (0.0, 0.0, 0.0), free_fall: bool = False
) -> Sensors:
    """Return sensors whose axes are aligned with the body."""
    generator = np.random.default_rng(5)
    made = Sensors(generator, profile, IDENTITY, IDENTITY, np.array(bias), free_fall)
    made.restart()
    return made


def test_without_noise_the_sample_is_the_motion_in_the_units_of_the_unit() -> None:
    sample = sensors(PROFILES["none"], (1e-3, 2e-3, 3e-3)).measure(MOTION, (4, 4, 4))
    np.testing.assert_allclose(sample.quaternion, IDENTITY, atol=1e-15)
    np.testing.assert_allclose(sample.rate, [0.011, 0.022, 0.033])
    np.testing.assert_allclose(sample.mag, [0.2, -0.3, 0.4])
    np.testing.assert_allclose(sample.accel, [0.1, 0.2, -9.8])


@pytest.mark.parametrize("windows", [(1, 1, 1), (4, 9, 16), (0, 25, 4)])
def test_white_noise_has_the_density_over_400_hz_and_shrinks_with_the_root_of_each_window(
    windows: tuple[int, int, int],
) -> None:
    profile = NoiseProfile(rate_density=1e-4, field_density=1e-8, acceleration_density=1e-3)
    made = sensors(profile)
    samples = [made.measure(MOTION, windows) for _ in range(700)]
    mag, accel, gyro = (max(1, window) ** 0.5 for window in windows)
    for values, density, root in (
        ([sample.mag for sample in samples], 1e-4, mag),
        ([sample.accel for sample in samples], 1e-3, accel),
        ([sample.rate for sample in samples], 1e-4, gyro),
    ):
        assert np.std(values, axis=0).mean() == pytest.approx(density * math.sqrt(400.0) / root, rel=0.07)


def test_uniform_noise_fills_its_bounds_and_keeps_them() -> None:
    made = sensors(NoiseProfile(attitude_bound=1e-3, rate_bound=1e-4))
    samples = [made.measure(MOTION, (1, 1, 1)) for _ in range(400)]
    rates = np.array([sample.rate for sample in samples]) - MOTION.rate
    parts = np.array([sample.quaternion[:3] for sample in samples])
    for values, bound in ((rates, 1e-4), (parts, 1e-3)):
        assert np.all(np.abs(values) <= bound * (1.0 + 1e-9))
        assert np.all(values.max(axis=0) > 0.95 * bound)
        assert np.all(values.min(axis=0) < -0.95 * bound)


def test_the_constant_errors_stay_until_a_restart() -> None:
    made = sensors(NoiseProfile(static_attitude=(0.01, 0.02, 0.03), gyro_bias=1e-3))
    first, second = (made.measure(MOTION, (1, 1, 1)) for _ in range(2))
    np.testing.assert_array_equal(first.rate, second.rate)
    np.testing.assert_array_equal(first.quaternion, second.quaternion)
    biases, angles = [], []
    for _ in range(400):
        made.restart()
        sample = made.measure(MOTION, (1, 1, 1))
        biases.append(sample.rate - MOTION.rate)
        angles.append(2.0 * sample.quaternion[:3])
    np.testing.assert_allclose(np.std(biases, axis=0), 1e-3, rtol=0.15)
    np.testing.assert_allclose(np.std(angles, axis=0), [0.01, 0.02, 0.03], rtol=0.15)


def test_in_free_fall_the_attitude_starts_anywhere_and_drifts() -> None:
    made = sensors(PROFILES["none"], free_fall=True)
    before = made.measure(MOTION, (1, 1, 1)).quaternion
    steps = []
    for _ in range(300):
        after = made.measure(MOTION, (1, 1, 1)).quaternion
        steps.append(2.0 * math.acos(min(1.0, abs(float(before @ after)))))
        before = after
    assert math.sqrt(np.mean(np.square(steps))) == pytest.approx(0.01 * math.sqrt(3.0), rel=0.15)
    assert abs(made.measure(MOTION, (1, 1, 1)).quaternion[3]) < 0.999
