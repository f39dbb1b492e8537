"""Tests of the diagnosis of axes and coils with inexact rotations by hand, noise, and random axis swaps."""

from __future__ import annotations

from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from ground.bringup.diagnosis import (
    GRAVITY,
    CoilTest,
    Finding,
    Turns,
    diagnose_axes,
    diagnose_coils,
    signed_permutations,
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
        # The diagnosis blames the magnetometer, not the three coils.
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
