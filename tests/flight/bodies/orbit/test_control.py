"""Tests that Sun acquisition reports a missing Sun once, and that commands account for coil gains."""

from __future__ import annotations

import numpy as np

from flight.bodies.orbit.control import SunAcquisitionLaw, commanded
from flight.link.events import EventKind
from flight.loop.facts import EventLog
from hal.interfaces.devices import StringReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.control.coil_map import CoilMap
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.control.sun_acquisition import MEMORY, SunAcquisition, SunAcquisitionSettings
from knightcube.vision.solar_cells import SolarStringModel

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
        """Run for some seconds with string readings; return whether the coils were driven in the end."""
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


def test_it_says_that_the_sun_is_found_and_turns_to_it() -> None:
    seen = Seen()
    assert seen.fly(0, 6, np.maximum(np.concatenate([SUN, -SUN]), 0.0))
    assert [name for name, _ in seen.told] == ["sun-missed", "sun-found"]
    assert seen.told[0][1] == "the solar strings deliver no readings"


def test_by_a_field_that_is_stuck_it_does_nothing_until_the_field_lives_again() -> None:
    seen, lit = Seen(), np.maximum(np.concatenate([SUN, -SUN]), 0.0)
    assert seen.fly(0, 6, lit)
    assert not seen.fly(6, 12, lit, noise=0.0)
    assert seen.fly(12, 18, lit)


def test_in_the_dark_it_says_why_and_no_current_flows_in_a_body_that_does_not_turn() -> None:
    seen = Seen()
    assert not seen.fly(0, 6, np.zeros(6))
    assert [name for name, _ in seen.told] == ["sun-missed"]


def test_a_sun_that_has_gone_is_remembered_for_a_while_and_its_loss_told_with_the_reason() -> None:
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
