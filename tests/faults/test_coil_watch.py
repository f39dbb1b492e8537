"""A broken coil is found and named from what the supply and the body say; sound ones are left alone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flight.arrays import FloatArray
from flight.health.coil_hypotheses import Bounds, CoilFault, fits, foretell, supply_current
from flight.health.coil_watch import CoilWatch, CoilWatchSettings
from hal.interfaces.readings import PowerReading
from tests.faults.coil_bench import hold, observe

TARGET = -0.6
FAULT_AT = 6.0
FULL = 3.4 / 23.0
BOUNDS = Bounds((FULL, FULL, FULL), 3.5e-3, 0.2, 1.5e-3)


@pytest.mark.parametrize(
    ("fault", "names", "within"),
    [
        ("coil-x: open", {"OPEN", "UNCERTAIN"}, 4.5),
        ("coil-x: shorted", {"SHORTED"}, 4.0),
        ("coil-x: reversed", {"REVERSED"}, 6.0),
        ("bridge-x: a-low", {"A_LOW", "UNCERTAIN"}, 4.5),
        ("bridge-y: a-high", {"A_HIGH"}, 10.0),
    ],
)
def test_a_broken_axis_is_found_and_named(fault: str, names: set[str], within: float) -> None:
    seen = observe(hold(TARGET), FAULT_AT + within + 1.0, [f"{fault} @ {FAULT_AT}"])
    assert len(seen.found) == 1
    (when, axis, name) = seen.found[0]
    assert axis == fault[5 if fault.startswith("coil") else 7]
    assert name in names
    assert FAULT_AT < when < FAULT_AT + within
    assert not seen.watch.available["xyz".index(axis)]


def test_sound_coils_of_another_resistance_raise_no_suspicion() -> None:
    """15 % is copper at 60 degrees C; the commands of all three axes move."""
    seen = observe(hold(TARGET, noise=0.005, others=0.04), 20.0, gain=(0.87, 1.1, 1.0))
    assert seen.found == []
    assert seen.suspicious == 0
    assert seen.readings > 500


def test_a_monitor_that_lies_is_doubted_and_no_coil_is_taken_out_of_use() -> None:
    seen = observe(hold(TARGET), 15.0, [f"monitor: wrong @ {FAULT_AT}"])
    assert seen.found == []
    assert "feels no change" in seen.watch.monitor_doubted


def test_an_axis_that_is_never_driven_is_not_judged() -> None:
    seen = observe(hold(TARGET), 12.0, ["coil-y: open @ 2", "coil-z: shorted @ 2"])
    assert seen.found == []
    assert seen.suspicious == 0


def test_a_leg_stuck_high_is_braked_by_its_neutral_command() -> None:
    """Input A stuck high and B on for the whole period: both ends of the coil are high, nothing flows."""
    seen = observe(hold(TARGET), 20.0, ["bridge-y: a-high @ 6"])
    assert seen.watch.neutral[1] == pytest.approx(-FULL)
    command = np.array([-FULL])
    assert supply_current(command, CoilFault.A_HIGH, FULL) == pytest.approx(0.0)


def wander(rng: np.random.Generator, samples: int) -> FloatArray:
    """Return commands (k, 3) A like those of a flight: slow, with steps, often zero on two axes."""
    time = np.arange(samples) * 0.025
    commands = np.zeros((samples, 3))
    for axis in range(3):
        if axis and rng.random() < 0.5:
            continue
        size = rng.uniform(0.0, 0.1)
        commands[:, axis] = size * np.sin(rng.uniform(0.1, 1.5) * time + rng.uniform(0, 6.3))
        commands[:, axis] += rng.uniform(-0.04, 0.04)
    return np.clip(commands, -FULL, FULL)


def test_in_twenty_minutes_of_wild_commands_there_is_no_false_alarm() -> None:
    """Readings as the driver makes them, 5,970, seed 11: not one is suspected, nor of an hour's 17,910.

    Each with a gain within 15 %, an error within the thesis's 3.5 mA on every driven coil in every cycle, and
    the monitor's steps. With none in N the rate of suspicions is below 3 / N at 95 %: one in 7 minutes of
    such wild commands at most; of them only those that leave one axis would become a verdict.
    """
    rng = np.random.default_rng(11)
    suspected = readings = 0
    for _ in range(30):
        commands = wander(rng, 40 * 41)
        driven = np.count_nonzero(commands, axis=0) > 0
        errors = rng.uniform(-3.5e-3, 3.5e-3, commands.shape) * driven
        supply = np.abs(rng.uniform(0.85, 1.15) * commands + errors).sum(axis=1)
        # A conversion is the mean of three cycles, one ends every eight; a reading is the mean of five.
        conversions = np.array([supply[end - 3 : end].mean() for end in range(8, len(supply), 8)])
        in_a_row = 0
        for last in range(5, len(conversions)):
            current = round(conversions[last - 4 : last + 1].mean(), 4)
            window = commands[8 * (last + 1) - 44 : 8 * (last + 1)]
            in_a_row = 0 if fits([foretell(current, window, BOUNDS)], BOUNDS, {}) else in_a_row + 1
            suspected += in_a_row >= 3
            readings += 1
    assert readings == 5_970
    assert suspected == 0


def test_a_gap_in_the_readings_begins_the_watch_anew() -> None:
    watch = CoilWatch(CoilWatchSettings((FULL, FULL, FULL)))
    currents = np.array([0.05, 0.0, 0.0])

    def feed(begin: float, end: float, current: float, period: float = 0.2) -> None:
        for time in np.arange(begin, end, 0.025):
            watch.commanded(round(time * 1e9), currents)
            if math.isclose(time / period, round(time / period), abs_tol=1e-6):
                watch.measured(PowerReading(round(time * 1e9), 5.0, current, 0.0))

    def is_suspicious() -> bool:
        return bool(watch.suspicion)

    feed(0.0, 3.0, 0.05)
    assert not is_suspicious()
    feed(3.0, 4.0, 0.0)
    assert is_suspicious()
    watch.interrupted()
    assert not is_suspicious()
    feed(4.0, 4.9, 0.0)
    assert not is_suspicious(), "the driver's mean is not whole yet"
    feed(4.9, 9.0, 0.0)
    assert [verdict.axis for verdict in watch.verdicts] == [0]
    watch.forget(0)
    assert watch.available.all()
