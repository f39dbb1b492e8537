"""The coil drive leaves resting coils undriven and adopts the rate above which coils may only rest."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from flight.loop.coil_monitor import CoilMonitor
from flight.loop.facts import Services
from flight.loop.steering import CoilDrive, CoilDriveSettings
from flight.schema.sections import Modes
from hal.interfaces.devices import TorqueCoils
from knightcube.astro.arrays import FloatArray

FIELD = np.array([2e-5, -1e-5, 3e-5])
DIPOLE = 0.65


class Coils:
    """Keeps the newest command."""

    def __init__(self) -> None:
        self.currents: FloatArray = np.zeros(3)

    def command(self, currents: FloatArray) -> None:
        self.currents = currents


def _drive(resting: list[bool]) -> tuple[CoilDrive, Coils, SimpleNamespace]:
    coils = Coils()
    watch = SimpleNamespace(
        resting=np.array(resting), at_rest=False, probe=np.zeros(3), suspicion="", tumble_rate=0.0175
    )
    settings = CoilDriveSettings(DIPOLE, np.full(3, 0.148), None)
    services = SimpleNamespace(facts=None, events=None)
    drive = CoilDrive(
        cast(TorqueCoils, coils), None, cast(CoilMonitor, watch), settings, cast(Services, services)
    )
    return drive, coils, watch


def test_a_resting_coil_carries_nothing_and_the_others_make_the_torque() -> None:
    asked = np.array([0.02, 0.03, -0.01])
    drive, coils, _ = _drive([False, True, False])
    drive.send(asked, lambda: FIELD)
    assert coils.currents[1] == pytest.approx(0.0, abs=1e-12)
    wanted, made = (np.cross(DIPOLE * currents, FIELD) for currents in (asked, coils.currents))
    assert made == pytest.approx(wanted, rel=1e-6)


def test_without_a_field_a_resting_coil_is_left_out() -> None:
    drive, coils, _ = _drive([False, True, False])
    drive.send(np.array([0.02, 0.03, -0.01]), lambda: None)
    assert coils.currents.tolist() == [0.02, 0.0, -0.01]


def test_coils_that_do_not_rest_get_what_is_asked() -> None:
    drive, coils, _ = _drive([False, False, False])
    drive.send(np.array([0.02, 0.03, -0.01]), lambda: FIELD)
    assert coils.currents.tolist() == [0.02, 0.03, -0.01]


def test_a_loaded_parameter_changes_the_rate_above_which_coils_may_only_rest() -> None:
    drive, _, watch = _drive([False, False, False])
    drive.adopt(Modes(tumble_rate=0.3))
    assert watch.tumble_rate == 0.3
