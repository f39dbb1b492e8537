"""The Helmholtz coil gives the fields that the thesis prints (5.34 and the text after it)."""

from __future__ import annotations

import pytest

from flight.schema import reader
from flight.schema.document import config_path
from flight.schema.testbed import as_testbed
from sim_hal.worlds.testbed import helmholtz_field

RADIUS, CURRENT, MEASURED = 0.15, 2.19, 9.98e-4
"""m, A, T: "approximately 15 cm", "9.98 gauss ... at a current of 2.19 A"."""
TURNS = 76
"""Of each coil: the whole number that 5.34 makes of the measurement; the thesis gives none."""


def test_the_measured_field_is_that_of_76_turns() -> None:
    assert helmholtz_field(TURNS, CURRENT, RADIUS) == pytest.approx(MEASURED, rel=2e-3)
    for other in (TURNS - 1, TURNS + 1):
        assert helmholtz_field(other, CURRENT, RADIUS) != pytest.approx(MEASURED, rel=1e-2)


def test_the_field_that_is_flown_takes_0_99_ampere() -> None:
    """4.5 gauss, "approximately 9 times Earth's ambient magnetic field strength of 0.5 gauss"."""
    flown = as_testbed(reader.load(config_path("step_simulation"))).plant.field
    current = CURRENT * flown / MEASURED
    assert current == pytest.approx(0.99, abs=0.005)
    assert helmholtz_field(TURNS, current, RADIUS) == pytest.approx(4.5e-4, rel=2e-3)
    assert flown == pytest.approx(9 * 0.5e-4)


def test_it_is_biot_and_savart_summed_over_the_two_coils() -> None:
    """On the axis of a loop B = mu0 I R^2 / (2 (R^2 + z^2)^1.5); here twice, at z = R / 2."""
    mu, radius = 1.25663706127e-6, 0.3  # CODATA 2022
    loop = mu * radius**2 / (2.0 * (radius**2 + (radius / 2.0) ** 2) ** 1.5)
    assert helmholtz_field(10, 2.0, radius) == pytest.approx(2 * 10 * 2.0 * loop, rel=1e-8)
