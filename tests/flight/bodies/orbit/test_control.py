"""Tests that Sun acquisition reports a missing Sun once, and that commands account for coil gains."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.bodies.orbit.control import (
    FieldDetumblingLaw,
    PointingTracker,
    SunAcquisitionLaw,
    commanded,
    expected_field,
)
from flight.link.events import EventKind
from flight.loop.body import CoilCommand
from flight.loop.facts import EventLog
from hal.interfaces.devices import StringReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.quaternion import attitude_matrix, normalise
from knightcube.gnc.control.coil_map import CoilMap
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.control.pointing_law import damping_dipole
from knightcube.gnc.control.sun_acquisition import MEMORY, SunAcquisition, SunAcquisitionSettings
from knightcube.vision.solar_cells import SolarStringModel
from tests.support.circular_orbits import circular

SUN = np.array([0.36, 0.48, 0.8])
FIELD = np.array([2e-5, 0.0, 3e-5])


class Seen:
    """The control law of Sun acquisition, with a record of its events."""

    def __init__(self) -> None:
        self.told: list[tuple[str, str]] = []
        law = SunAcquisition(
            WindowSchedule(SECOND_NS // 10, SECOND_NS // 10, 18 * SECOND_NS // 10),
            SunAcquisitionSettings(inertia=1e-3 * np.eye(3), axis=np.array([1.0, 0.0, 0.0]), limit=0.1),
        )
        self.law = SunAcquisitionLaw(
            law, SolarStringModel(), CoilMap.equal(0.648, 0.148), EventLog(self._tell)
        )
        self.law.begin(0)

    def _tell(self, kind: EventKind, _time_ns: int, _held: int, text: str) -> None:
        self.told.append((kind.name, text))

    def fly(self, begin: int, end: int, currents: FloatArray | None, noise: float = 1e-9) -> bool:
        """Run with readings of the solar strings; return whether the last command drives the coils."""
        acted = False
        for tenth in range(10 * begin + 1, 10 * end):
            now_ns = tenth * SECOND_NS // 10
            if currents is not None and tenth % 10 == 0:
                self.law.update_sun(StringReading(now_ns, currents))
            self.law.sample(now_ns, FIELD + noise * (tenth % 2), np.zeros(3))
            command = self.law.command(now_ns)
            acted = (acted and tenth < 10 * end - 20) or bool(command.currents.any())
            np.testing.assert_allclose(command.currents * 0.648, command.dipole)
        return acted


def test_the_sun_is_reported_as_found_and_the_body_turns_to_it() -> None:
    seen = Seen()
    assert seen.fly(0, 6, np.maximum(np.concatenate([SUN, -SUN]), 0.0))
    assert [name for name, _ in seen.told] == ["sun-missed", "sun-found"]
    assert seen.told[0][1] == "the solar strings deliver no readings"


def test_no_coil_is_driven_while_the_measured_field_is_stuck() -> None:
    seen, lit = Seen(), np.maximum(np.concatenate([SUN, -SUN]), 0.0)
    assert seen.fly(0, 6, lit)
    assert not seen.fly(6, 12, lit, noise=0.0)
    assert seen.fly(12, 18, lit)


def test_in_the_dark_the_missing_sun_is_reported_and_a_body_at_rest_gets_no_current() -> None:
    seen = Seen()
    assert not seen.fly(0, 6, np.zeros(6))
    assert [name for name, _ in seen.told] == ["sun-missed"]


def test_a_lost_sun_is_remembered_for_a_while_and_its_loss_is_reported_with_the_reason() -> None:
    seen = Seen()
    seen.fly(0, 6, np.maximum(np.concatenate([SUN, -SUN]), 0.0))
    seen.fly(6, int(MEMORY), np.zeros(6))
    assert seen.told[-1][0] == "sun-found"
    seen.fly(int(MEMORY), int(MEMORY) + 10, np.zeros(6))
    assert seen.told[-1][0] == "sun-missed"
    assert "no string has" in seen.told[-1][1]


def test_the_command_for_learned_coils_causes_the_wanted_dipole() -> None:
    wanted = np.array([0.05, -0.02, 0.01])
    coils = np.array([[0.82, 0.03, -0.02], [0.05, 1.17, 0.0], [-0.04, 0.01, 1.1]])
    np.testing.assert_allclose(coils @ commanded(wanted, coils), wanted, atol=1e-12)


def test_the_command_for_a_coil_that_seems_dead_stays_bounded() -> None:
    """The command of a coil is divided by its estimated gain, but by no less than 0.7."""
    wanted = np.array([0.05, -0.02, 0.01])
    np.testing.assert_allclose(commanded(wanted, np.diag([1.0, 0.0, -1.0])), wanted / [1.0, 0.7, 0.7])


S = SECOND_NS
WINDOWS = WindowSchedule(S // 10, S // 10, 18 * S // 10)
COILS = CoilMap(np.diag([0.6, 0.7, 0.8]), np.array([0.1, 0.2, 0.3]), np.array([20.0, 30.0, 40.0]))


class Pointing:
    """The pointing tracker with a path law, a filter and an environment that the test sets."""

    def __init__(self) -> None:
        self.dipole = np.array([0.02, -0.03, 0.01])
        self.follows = True
        self.asked: list[tuple[Any, ...]] = []
        self.led: list[tuple[Any, ...]] = []
        self.field: FloatArray | None = FIELD
        self.filter = SimpleNamespace(
            residual_dipole=np.array([1e-3, 2e-3, -1e-3]), torque_sizes=np.arange(9.0), coil_matrix=np.eye(3)
        )
        self.estimate = cast(
            Any,
            SimpleNamespace(
                quaternion=normalise(np.array([0.1, -0.2, 0.3, 0.9])), rate=np.array([0.01, 0.02, -0.01])
            ),
        )
        environment = SimpleNamespace(field=lambda now_ns: self.field)
        self.inertia = np.diag([1e-3, 2e-3, 3e-3])
        self.tracker = PointingTracker(
            cast(Any, self.filter), cast(Any, environment), WINDOWS, COILS, self.inertia
        )
        self.law = SimpleNamespace(command=self._command)
        self.paths = SimpleNamespace(led=self._led)

    def _command(self, *arguments: Any) -> Any:
        self.asked.append(arguments)
        return SimpleNamespace(dipole=self.dipole, rotation=np.array([0.1, 0.2, 0.3]))

    def _led(self, *arguments: Any) -> bool:
        self.led.append(arguments)
        return self.follows

    def at(self, now_ns: int, law: Any = None) -> CoilCommand:
        """Return the command at a time."""
        reference = SimpleNamespace(
            time_ns=now_ns, seconds=now_ns / S, law=self.law if law is None else law, paths=self.paths
        )
        return self.tracker.command(self.estimate, cast(Any, reference))


def test_no_current_flows_while_the_magnetometer_is_read() -> None:
    pointing = Pointing()
    for now_ns in (4 * S, 4 * S + S // 5 - 1):
        assert not pointing.at(now_ns).dipole.any()
        assert not pointing.at(now_ns).currents.any()
    assert pointing.asked == []
    assert pointing.at(4 * S + S // 5).dipole.any()


def test_the_mean_dipole_of_a_window_is_that_of_the_law_and_held_until_it_ends() -> None:
    pointing = Pointing()
    first = pointing.at(4 * S + S // 5)
    np.testing.assert_allclose(first.dipole * 0.9, pointing.dipole)
    np.testing.assert_allclose(np.diag([0.6, 0.7, 0.8]) @ first.currents, first.dipole)
    assert not first.saturated
    pointing.dipole = np.zeros(3)
    assert pointing.at(6 * S - 1) is first
    assert len(pointing.asked) == 1
    assert not pointing.at(6 * S + S // 5).dipole.any()
    assert len(pointing.asked) == 2, "a new window"
    pointing.at(6 * S + S // 2, SimpleNamespace(command=pointing._command, number=2))
    assert len(pointing.asked) == 3, "a new path"
    pointing.at(6 * S + S // 2 + 1)
    pointing.tracker.reset()
    pointing.at(6 * S + S // 2 + 2)
    assert len(pointing.asked) == 5


def test_the_law_gets_the_field_in_body_axes_and_what_the_filter_learned() -> None:
    pointing = Pointing()
    now_ns = 4 * S + S // 2
    pointing.at(now_ns)
    ((seconds, quaternion, rate, field, residual, sizes),) = pointing.asked
    assert seconds == 4.5
    assert quaternion is pointing.estimate.quaternion
    assert rate is pointing.estimate.rate
    np.testing.assert_allclose(field, attitude_matrix(quaternion) @ FIELD)
    assert residual is pointing.filter.residual_dipole
    assert sizes is pointing.filter.torque_sizes
    ((rotation, led_rate, at),) = pointing.led
    assert rotation.tolist() == [0.1, 0.2, 0.3]
    assert led_rate is pointing.estimate.rate
    assert at == now_ns


def test_far_off_the_path_the_rotation_is_damped() -> None:
    """The torque of the damping dipole and the residual dipole takes energy from the rotation."""
    pointing = Pointing()
    pointing.follows = False
    sent = pointing.at(4 * S + S // 2).dipole
    field = attitude_matrix(pointing.estimate.quaternion) @ FIELD
    acting = 0.9 * sent + pointing.filter.residual_dipole
    torque = np.cross(acting, field)
    assert torque @ pointing.estimate.rate < 0.0
    expected = damping_dipole(pointing.inertia, pointing.estimate.rate, field)
    np.testing.assert_allclose(acting, expected, atol=1e-12)


def test_without_an_orbit_no_current_flows() -> None:
    pointing = Pointing()
    pointing.field = None
    assert not pointing.at(4 * S + S // 2).currents.any()


def test_learned_coils_are_compensated_and_a_large_dipole_is_limited() -> None:
    pointing = Pointing()
    pointing.filter.coil_matrix = np.diag([0.8, 1.1, 1.0])
    sent = pointing.at(4 * S + S // 2)
    np.testing.assert_allclose(np.diag([0.8, 1.1, 1.0]) @ sent.dipole * 0.9, pointing.dipole)
    pointing.dipole = np.array([0.5, -0.1, 0.05])
    large = pointing.at(6 * S + S // 2)
    assert large.saturated
    assert np.all(np.abs(large.dipole) <= COILS.limits * (1.0 + 1e-9))
    assert np.abs(large.dipole / COILS.limits).max() == pytest.approx(1.0)


def test_the_expected_field_is_in_body_axes_once_the_attitude_is_known() -> None:
    instants = np.array([0.0, 10.0, 60.0])
    orbit = circular(3_000.0)
    state = OrbitState(orbit.julian_date, orbit.position_at(np.zeros(1))[0], np.array([0.0, 7.6e3, 0.0]), 0.0)
    attitude = normalise(np.array([0.1, -0.2, 0.3, 0.9]))
    known: list[Any] = [None]
    filter_ = SimpleNamespace(started=False, at=lambda now_ns: SimpleNamespace(quaternion=attitude))
    environment = SimpleNamespace(state=lambda now_ns: known[0], at=lambda now_ns: known[0])
    expected = expected_field(cast(Any, filter_), cast(Any, environment), instants)
    assert expected(5) is None
    known[0] = state
    inertial = expected(5)
    assert inertial is not None
    assert inertial.field.shape == (3, 3)
    strength = np.linalg.norm(inertial.field, axis=1)
    assert ((strength > 1.5e-5) & (strength < 7e-5)).all(), "the Earth's field in low orbit"
    filter_.started = True
    body = expected(5)
    assert body is not None
    np.testing.assert_allclose(body.field, inertial.field @ attitude_matrix(attitude).T, atol=1e-12)
    assert (inertial.in_body_axes, body.in_body_axes) == (False, True)


def test_a_windowed_law_gets_the_dipole_of_the_currents_that_flow() -> None:
    acted: list[FloatArray] = []
    law = SimpleNamespace(acts=acted.append, field=FIELD, begin=lambda now: None, sample=lambda *_: None,
                          dipole=lambda now: np.array([0.01, 0.02, 0.03]))  # fmt: skip
    detumbling = FieldDetumblingLaw(cast(Any, law), COILS)
    assert detumbling.detumbler is cast(Any, law)
    command = detumbling.command(5)
    np.testing.assert_allclose(np.diag([0.6, 0.7, 0.8]) @ command.currents, [0.01, 0.02, 0.03])
    detumbling.sent(np.array([0.1, 0.2, 0.1]))
    np.testing.assert_allclose(acted[-1], [0.06, 0.14, 0.08])
    assert detumbling.field(5) is FIELD
