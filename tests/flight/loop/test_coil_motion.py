"""Tests of the record of commands, and of coil gains and faults from the motion of a simulated body."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flight.loop.coil_currents import Bounds, BrakeProof, CoilFault, supply_currents
from flight.loop.coil_response import CoilCommands, CoilResponse, Finding, ResponseSettings
from hal.interfaces.devices import NO_AXES, PowerReading
from knightcube.astro.arrays import FloatArray

CYCLE_NS = 25_000_000
INERTIA: FloatArray = np.array([[1.1e-3, 4e-5, 0.0], [4e-5, 1.5e-3, -3e-5], [0.0, -3e-5, 0.8e-3]])
DIPOLES: FloatArray = np.array([[0.6, 0.1, 0.0], [0.0, 0.7, 0.05], [0.02, 0.0, 0.8]])
"""Dipole moment of each coil per ampere, m^2, one column per coil."""
FIELD: FloatArray = np.array([1.3e-4, -0.9e-4, 1.6e-4])


def settings() -> ResponseSettings:
    """Return settings for a gyro with little noise."""
    return ResponseSettings(INERTIA, DIPOLES, 1e-5, model_error=1e-6, torsion=1e-6, damping=1e-6)


_INVERSE = np.linalg.inv(INERTIA)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross product (3,) of two vectors. numpy.cross takes ten times as long."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def _acceleration(rate: FloatArray, field: FloatArray, carried: FloatArray) -> FloatArray:
    """Return the angular acceleration (3,), rad/s^2, by Euler's equation for currents (3,), A."""
    return np.asarray(_INVERSE @ (_cross(DIPOLES @ carried, field) - _cross(rate, INERTIA @ rate)))


class Body:
    """A body whose coils have the given gains, in a field that is fixed in inertial axes."""

    def __init__(self, gains: FloatArray) -> None:
        self.gains, self.rate, self.field = gains.astype(float), np.array([0.05, -0.04, 0.03]), FIELD.copy()
        self.response = CoilResponse(settings())
        self.now_ns = 0
        self.stuck: dict[int, float] = {}  # currents (A) that coils carry instead of their commands

    def command(self, cycle: int) -> FloatArray:
        """Return currents (3,), A, that change their signs at different times."""
        return np.array(
            [
                0.10 * math.copysign(1.0, math.sin(0.21 * cycle)),
                0.08 * math.sin(0.33 * cycle),
                0.07 * math.cos(0.27 * cycle),
            ]
        )

    def fly(self, cycles: int) -> None:
        """Simulate some control cycles, and pass commands and samples to the response."""
        for _ in range(cycles):
            current = self.command(self.now_ns // CYCLE_NS)
            self.response.commanded(self.now_ns, tuple(current.tolist()))
            carried = self.gains * current
            for axis, value in self.stuck.items():
                carried[axis] = value
            for _ in range(2):
                step = 0.5e-9 * CYCLE_NS
                half = self.rate + 0.5 * step * _acceleration(self.rate, self.field, carried)
                middle = self.field - 0.5 * step * _cross(self.rate, self.field)
                self.rate = self.rate + step * _acceleration(half, middle, carried)
                self.field = self.field - step * _cross(half, middle)
            self.now_ns += CYCLE_NS
            self.response.observe_motion(self.now_ns - 1, self.rate.copy(), self.field.copy())


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("gain", "finding"),
    [(-1.0, Finding.REVERSED), (0.0, Finding.FEEBLE), (0.45, Finding.WEAK), (1.4, Finding.STRONG)],
)
def test_the_gain_of_a_coil_follows_from_the_motion(axis: int, gain: float, finding: Finding) -> None:
    gains = np.ones(3)
    gains[axis] = gain
    body = Body(gains)
    body.fly(110)
    assert body.response.gain[axis] == pytest.approx(gain, abs=0.02)
    assert body.response.axes(finding) == [axis]
    assert not body.response.is_healthy(axis) or gain == 1.4
    assert 0.0 < body.response.sigma[axis] < 0.1
    assert f"{body.response.gain[axis]:+.2f}" in body.response.text(axis)
    others = {Finding.REVERSED, Finding.WEAK, Finding.STRONG} - {finding}
    assert all(body.response.axes(other) == [] for other in others)


def test_healthy_coils_are_sound_after_three_fits() -> None:
    body = Body(np.ones(3))
    fits = 0
    while not body.response.is_healthy(0):
        before = body.response.sigma.copy()
        body.fly(1)
        fits += not np.array_equal(before, body.response.sigma)
        assert body.now_ns < 10_000_000_000
    assert fits == 3
    np.testing.assert_allclose(body.response.gain, 1.0, atol=0.02)
    assert [body.response.is_healthy(axis) for axis in range(3)] == [True] * 3
    speed = float(np.linalg.norm(body.rate))
    assert body.response.fastest == pytest.approx(speed, rel=0.05)
    body.response.interrupted(body.now_ns)
    assert not body.response.is_healthy(0)
    assert np.isinf(body.response.sigma).all()


def test_samples_from_before_an_interruption_are_ignored() -> None:
    body = Body(np.ones(3))
    body.response.interrupted(10 * CYCLE_NS)
    body.fly(9)
    assert body.response._samples == []
    body.fly(3)
    assert body.response._samples != []


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("carried", "share"), [(0.0, 1.0), (0.148, 1.0), (None, 0.0)])
def test_the_share_of_a_suspected_fault_in_the_motion(axis: int, carried: float | None, share: float) -> None:
    """The share is one if the coil carries the suspected current, and zero if it carries its command."""
    body = Body(np.ones(3))
    body.fly(80)
    since_ns = body.now_ns
    if carried is not None:
        body.stuck[axis] = carried
    body.command = lambda cycle: np.array([0.1, -0.09, 0.08])  # type: ignore[method-assign]
    body.fly(45)
    found = body.response.observed_share(axis, carried or 0.0, since_ns, since_ns + 10 * CYCLE_NS)
    assert found == pytest.approx(share, abs=0.25 if share else 0.05)
    few = body.response.observed_share(axis, 0.0, since_ns, body.now_ns)
    assert few is not None
    assert math.isnan(few), "no residual after the fault"
    same = body.response.observed_share(axis, [0.1, -0.09, 0.08][axis], since_ns, since_ns + 10 * CYCLE_NS)
    assert same is None, "a fault that changes nothing cannot be observed"


def strength_of(response: CoilResponse) -> Any:
    """Return the strength of the coils, or None."""
    return response.strength


def test_the_strength_of_the_coils_is_their_acceleration_in_the_field_of_the_last_pause() -> None:
    found = CoilResponse(ResponseSettings(INERTIA, DIPOLES, 1e-5, settle_ns=100_000_000))
    assert strength_of(found) is None
    found.commanded(5, (0.1, 0.0, 0.0))
    found.observe_motion(CYCLE_NS, np.zeros(3), FIELD)
    found.observe_motion(2 * CYCLE_NS, np.zeros(3), FIELD)
    assert strength_of(found) is None, "the coils are driven"
    found.commanded(2 * CYCLE_NS, (0.0, 0.0, 0.0))
    found.observe_motion(6 * CYCLE_NS - 1, np.zeros(3), FIELD)
    assert strength_of(found) is None, "their field has not decayed"
    found.observe_motion(6 * CYCLE_NS, np.zeros(3), FIELD)
    expected = [np.linalg.norm(np.linalg.solve(INERTIA, np.cross(DIPOLES[:, k], FIELD))) for k in range(3)]
    np.testing.assert_allclose(strength_of(found), expected)
    found.commanded(6 * CYCLE_NS, (0.1, 0.0, 0.0))
    turn = np.array([0.0, 0.0, 0.4])
    for cycle in range(7, 15):
        found.observe_motion(cycle * CYCLE_NS, turn, np.full(3, 1.0))
    angle = 0.4 * 8 * 0.025
    c, s = math.cos(angle), math.sin(angle)
    turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ FIELD
    expected = [np.linalg.norm(np.linalg.solve(INERTIA, np.cross(DIPOLES[:, k], turned))) for k in range(3)]
    np.testing.assert_allclose(strength_of(found), expected, rtol=2e-3)


def test_a_window_has_the_commands_in_force_and_one_cycle_more() -> None:
    commands = CoilCommands(10 * CYCLE_NS)
    assert not commands
    for cycle in range(1, 5):
        commands.note(cycle * CYCLE_NS, (0.1 * cycle, 0.0), NO_AXES)
    assert commands
    assert commands.newest_ns == 4 * CYCLE_NS
    for begin_ns, end_ns, expected in (
        (2 * CYCLE_NS, 3 * CYCLE_NS, [0.2, 0.3, 0.4]),
        (0, CYCLE_NS, [0.1, 0.1, 0.2]),
        (3 * CYCLE_NS - 1, 3 * CYCLE_NS - 1, [0.2, 0.3]),
    ):
        first = [currents[0] for currents in commands.window(begin_ns, end_ns)]
        assert first == pytest.approx(expected)


def test_commands_are_forgotten_when_a_later_one_has_been_in_force_for_the_whole_reach() -> None:
    commands = CoilCommands(2 * CYCLE_NS)
    for cycle in range(5):
        commands.note(cycle * CYCLE_NS, (0.1 * cycle,), NO_AXES)
    assert commands.is_known_since(2 * CYCLE_NS)
    assert not commands.is_known_since(2 * CYCLE_NS - 1)
    commands.note(5 * CYCLE_NS, (0.0,), frozenset({0}))
    assert commands.is_known_since(5 * CYCLE_NS)
    assert not commands.is_known_since(5 * CYCLE_NS - 1), "the braking has changed"
    commands.note(6 * CYCLE_NS, (0.0,), frozenset({0}))
    assert commands.is_known_since(5 * CYCLE_NS)


def reading(milliamperes: float) -> PowerReading:
    """Return a reading of the current monitor whose newest sample covers the cycles 2 to 4."""
    current = 1e-3 * milliamperes
    values = {"newest": current, "newest_since_ns": 2 * CYCLE_NS}
    return PowerReading(4 * CYCLE_NS, 5.0, current, 5.0 * current, **values)  # type: ignore[arg-type]


def test_the_supply_current_of_healthy_coils_is_bounded_by_their_commands() -> None:
    commands = CoilCommands(10 * CYCLE_NS)
    for cycle, total in enumerate((0.10, 0.10, 0.10, 0.12, 0.14)):
        commands.note(cycle * CYCLE_NS, (0.5 * total, -0.5 * total, 0.0), NO_AXES)
    bounds = Bounds((0.148, 0.148, 0.148), 3e-3, 0.1, 1e-3)
    found = commands.supplied(reading(110.0), bounds, {})
    slack = 2 * 3e-3 + 1e-3
    assert found.current == pytest.approx(0.11)
    assert found.least == pytest.approx(0.10 * (1.0 - 0.3) - slack)
    assert found.most == pytest.approx(0.14 * (1.0 + 0.3) + slack)
    assert found.spread == pytest.approx(0.04)
    assert (found.at_rest, found.driven) == ([2], True)
    shorted = commands.supplied(reading(110.0), bounds, {0: CoilFault.SHORTED})
    assert shorted.most == pytest.approx(found.most + 0.148), "a shorted coil may draw any current"
    assert shorted.least == pytest.approx(found.least)
    opened = commands.supplied(reading(110.0), bounds, {0: CoilFault.OPEN, 2: CoilFault.OPEN})
    assert opened.least == pytest.approx(0.05 * 0.7 - slack), "an open coil draws nothing"
    assert opened.most == pytest.approx(found.most)
    assert opened.at_rest == []


def test_each_fault_of_a_bridge_has_its_supply_current() -> None:
    commands = np.array([[0.05, -0.04, 0.0]])
    full = np.array([[0.148]])
    healthy, opened, shorted, a_low, b_low, a_high, b_high = supply_currents(commands, full)[0]
    np.testing.assert_allclose(healthy, [0.05, 0.04, 0.0])
    np.testing.assert_allclose(shorted, healthy)
    np.testing.assert_allclose(opened, 0.0)
    np.testing.assert_allclose(a_low, [0.0, 0.04, 0.0])
    np.testing.assert_allclose(b_low, [0.05, 0.0, 0.0])
    np.testing.assert_allclose(a_high, [0.148, 0.108, 0.148])
    np.testing.assert_allclose(b_high, [0.098, 0.148, 0.148])


def test_two_samples_that_agree_end_the_proof_of_a_brake() -> None:
    proof = BrakeProof()
    assert not proof
    proof.add(2)
    assert proof
    assert proof.ingest(True) == frozenset()
    assert proof.ingest(False) == frozenset()
    assert proof
    assert proof.ingest(True) == frozenset()
    assert proof.ingest(True) == {2}
    assert not proof
    proof.add(1)
    proof.discard(1)
    assert not proof
