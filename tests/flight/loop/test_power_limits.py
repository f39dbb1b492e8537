"""Tests of the limits of the power system, with readings that the test gives."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.link.events import Mode
from flight.loop import facts
from flight.loop.facts import EventLog, Facts
from flight.loop.power import ChargeEstimate, MonitorWatch, PowerTask, Sheddable
from flight.schema.devices import Battery, LowBattery, Power
from hal.interfaces.devices import PowerReading

S = 1_000_000_000
LINEAR = Battery(capacity=2.0, cells=2, resistance=0.2, open_circuit=(3.0, 4.0))
"""Battery whose open-circuit voltage is 6 V when empty and 8 V when full."""


class Monitor:
    """A current monitor with a given reading and error."""

    def __init__(self) -> None:
        self.reading: PowerReading | None = None
        self.said = ""

    def latest(self) -> PowerReading | None:
        return self.reading

    def error(self) -> str:
        return self.said

    def close(self) -> None: ...

    def show(self, now_ns: int, voltage: float, current: float) -> None:
        """Set the reading."""
        self.reading = PowerReading(now_ns, voltage, current, voltage * current, current, now_ns)


def test_the_first_charge_is_that_of_the_open_circuit_voltage() -> None:
    """The voltage at the terminals is lower than the open-circuit voltage by resistance times current."""
    estimate = ChargeEstimate(LINEAR)
    assert math.isnan(estimate.charge)
    estimate.update(6.9, 0.5, 1.0, 1800.0)
    assert estimate.charge == pytest.approx(0.5)


def test_the_current_is_integrated_and_corrected_by_the_voltage() -> None:
    estimate = ChargeEstimate(LINEAR)
    estimate.update(6.9, 0.5, 1.0, 1800.0)
    # In 4 s, 0.5 A take 2 A s of 7200 A s; the open-circuit voltage corresponds to a charge of 0.6.
    estimate.update(7.1, 0.5, 4.0, 1800.0)
    integrated = 0.5 - 2.0 / 7200.0
    assert estimate.charge == pytest.approx(integrated + 4.0 / 1800.0 * (0.6 - integrated))
    before = estimate.charge
    estimate.update(7.2, 0.0, 1e4, 1800.0)
    assert estimate.charge == pytest.approx(0.6), "not beyond the charge of the voltage"
    assert before < 0.6


def test_a_current_is_integrated_for_five_seconds_at_most() -> None:
    estimate = ChargeEstimate(LINEAR)
    estimate.update(7.0, 0.0, 1.0, 1e12)
    estimate.update(6.8, 1.0, 50.0, 1e12)
    assert estimate.charge == pytest.approx(0.5 - 5.0 / 7200.0, abs=1e-9)


@pytest.mark.parametrize(("charge", "fast"), [(0.74, False), (0.76, True)])
def test_a_voltage_that_contradicts_the_integrated_current_corrects_it_in_a_minute(
    charge: float, fast: bool
) -> None:
    estimate = ChargeEstimate(LINEAR)
    estimate.update(7.0, 0.0, 1.0, 1800.0)
    estimate.update(6.0 + 2.0 * charge, 0.0, 6.0, 1800.0)
    share = 6.0 / (60.0 if fast else 1800.0)
    assert estimate.charge == pytest.approx(0.5 + share * (charge - 0.5))


def test_the_charge_stays_between_zero_and_one() -> None:
    estimate = ChargeEstimate(LINEAR)
    estimate.update(6.0, 0.0, 1.0, 1e9)
    estimate.update(5.8, 1.0, 5.0, 1e9)
    assert estimate.charge == 0.0
    full = ChargeEstimate(LINEAR)
    full.update(8.0, 0.0, 1.0, 1e9)
    full.update(8.2, -1.0, 5.0, 1e9)
    assert full.charge == 1.0


@pytest.mark.parametrize(
    ("age", "voltage", "text"),
    [
        (5 * S, 7.0, ""),
        (5 * S + 1, 7.0, "bus: no reading for 5 s"),
        (0, 2.0, ""),
        (0, 9.2, ""),
        (0, 1.99, "bus: 1.99 V, possible are 2 to 9.2 V"),
        (0, 9.21, "bus: 9.21 V, possible are 2 to 9.2 V"),
        (0, math.nan, "bus: nan V, possible are 2 to 9.2 V"),
    ],
)
def test_a_reading_is_used_within_its_age_and_its_range(age: int, voltage: float, text: str) -> None:
    monitor = Monitor()
    watch = MonitorWatch("bus", cast(Any, monitor), 2)
    assert watch.read(0) == (None, "bus: no reading yet")
    monitor.show(9 * S, voltage, 0.1)
    reading, why = watch.read(9 * S + age)
    assert why == text
    assert (reading is None) is bool(text)
    monitor.said = "no acknowledge"
    assert watch.read(9 * S) == (None, "bus: no acknowledge")


def one(voltage: float, current: float = 0.1) -> PowerReading:
    """Return a reading."""
    return PowerReading(0, voltage, current, voltage * current, current, 0)


@pytest.mark.parametrize(
    ("seconds", "moved", "stuck"), [(10, 0.03, True), (9, 0.03, False), (10, 0.0199, False)]
)
def test_a_reading_is_stuck_for_ten_seconds_while_the_other_monitor_moves(
    seconds: int, moved: float, stuck: bool
) -> None:
    watch = MonitorWatch("bus", cast(Any, Monitor()), 2)
    assert watch.stuck(one(7.0), one(7.1), 0) == ""
    assert watch.stuck(one(7.0), one(7.1 - moved), 1 * S) == ""
    text = watch.stuck(one(7.0), one(7.1), seconds * S)
    assert bool(text) is stuck
    if stuck:
        assert text == f"bus: unchanged for 10 s, while the other monitor changed by {moved:.3f} V"
        assert watch.stuck(one(7.0, 0.2), one(7.1), 11 * S) == "", "it changes again"
        assert watch.stuck(one(7.0, 0.2), one(7.2), 20 * S) == ""
    assert MonitorWatch("bus", cast(Any, Monitor()), 2).stuck(one(7.0), None, 99 * S) == ""


class Bench:
    """The power task with two monitors that the test sets."""

    def __init__(self, bus: bool = True) -> None:
        self.monitors = [Monitor(), Monitor()][: 1 + bus]
        self.shares: list[float] = []
        self.rests: list[float] = []
        self.records: list[dict[str, float]] = []
        self.reports: list[str] = []
        log = EventLog(lambda kind, _, __, text: self.reports.append(f"{kind.name}: {text}"), throttle_ns=0)
        self.facts = Facts(log)
        self.facts.enter(Mode.POINT)
        services = SimpleNamespace(
            facts=self.facts,
            recorder=SimpleNamespace(record=lambda _, __, **values: self.records.append(values)),
        )
        limits = LowBattery(
            low=0.4, very_low=0.3, critical=0.2, hysteresis=0.1, coil_share=0.3, camera_period=60.0
        )
        self.task = PowerTask(
            Power(battery=LINEAR, low_battery=limits),
            cast(Any, self.monitors),
            Sheddable(self.shares.append, self.rests.append),
            cast(Any, services),
        )
        self.task.begin(0)
        self.second = 0

    def run(
        self, charge: float, count: int = 1, *, battery: bool = True, bus: bool = True, step: int = 1
    ) -> None:
        """Run the task with slightly scattered readings of the open-circuit voltage at a state of charge."""
        for number in range(count):
            self.second += step
            voltage = 6.0 + 2.0 * charge + 1e-6 * (number % 2)
            for monitor, works in zip(self.monitors, (battery, bus), strict=False):
                monitor.said = "" if works else "gone"
                monitor.show(self.second * S, voltage, 0.0)
            self.task.run(self.second * S)


def test_loads_are_shed_and_return_in_the_order_of_the_charge() -> None:
    bench = Bench()
    bench.run(0.9, 2)
    assert (bench.shares, bench.rests, bench.records[-1]["shed"]) == ([], [], 0)
    bench.run(0.35, 720, step=5)
    assert (bench.shares[-1], bench.rests[-1], bench.records[-1]["shed"]) == (0.3, 0.0, 1)
    bench.run(0.25, 720, step=5)
    assert (bench.shares[-1], bench.rests[-1], bench.records[-1]["shed"]) == (0.3, 60.0, 2)
    bench.run(0.38, 720, step=5)
    assert bench.records[-1]["shed"] == 2, "within the hysteresis of 0.1"
    bench.run(0.45, 720, step=5)
    assert (bench.shares[-1], bench.rests[-1], bench.records[-1]["shed"]) == (0.3, 0.0, 1)
    bench.run(0.9, 120, step=5)
    assert (bench.shares[-1], bench.rests[-1], bench.records[-1]["shed"]) == (1.0, 0.0, 0)
    assert [text.split(":")[0] for text in bench.reports][:2] == ["battery-low", "battery-very-low"]


def test_without_a_reading_the_charge_is_unknown_and_the_loads_stay() -> None:
    bench = Bench()
    assert bench.task.summary() == "state of charge unknown"
    bench.run(0.35, 60)
    shed = bench.records[-1]["shed"]
    bench.run(0.9, 30, battery=False, bus=False)
    last = bench.records[-1]
    assert np.isnan(
        [last[name] for name in ("charge", "battery_voltage", "battery_current", "bus_voltage")]
    ).all()
    assert last["shed"] == shed
    assert bench.facts.holds(facts.BATTERY_MONITOR_LOST)
    assert bench.facts.holds(facts.BUS_MONITOR_LOST)
    bench.run(0.9, 30)
    assert not bench.facts.holds(facts.BATTERY_MONITOR_LOST)


def test_energies_into_and_out_of_the_battery_are_summed() -> None:
    bench = Bench(bus=False)
    battery = bench.monitors[0]
    for second, current in enumerate((0.5, 0.5, -0.2), start=1):
        battery.show(second * S, 7.0, current)
        bench.task.run(second * S)
    last = bench.records[-1]
    assert last["energy_out"] == pytest.approx(2 * 3.5)
    assert last["energy_in"] == pytest.approx(1.4)
    assert (last["battery_voltage"], last["battery_current"]) == (7.0, -0.2)
    assert math.isnan(last["bus_voltage"])
    battery.show(63 * S, 7.0, 0.1)
    bench.task.run(63 * S)
    assert bench.records[-1]["energy_out"] == pytest.approx(7.0 + 0.7 * 5.0), "for five seconds at most"
    text = bench.task.summary()
    assert text.endswith("1.4 J into and 10.5 J out of the battery")
    lowest = min(record["charge"] for record in bench.records)
    assert f"at least {100.0 * lowest:.1f} %" in text


@pytest.mark.parametrize(("apart", "doubted"), [(0.199, False), (0.201, True)])
def test_monitors_that_differ_by_more_than_a_tenth_of_a_volt_per_cell_are_not_used(
    apart: float, doubted: bool
) -> None:
    bench = Bench()
    for second in range(1, 8):
        battery, bus = bench.monitors
        battery.show(second * S, 7.0 + 1e-3 * second, 0.1)
        bus.show(second * S, 7.0 + 1e-3 * second + apart, 0.1)
        bench.task.run(second * S)
    assert math.isnan(bench.records[-1]["charge"]) is doubted
    assert bench.facts.holds(facts.BUS_MONITOR_LOST) is doubted


def test_without_the_battery_monitor_the_charge_follows_from_the_bus() -> None:
    bench = Bench()
    bench.run(0.5, 2)
    bench.run(0.8, 30, battery=False)
    assert bench.records[-1]["charge"] == pytest.approx(0.8 - 0.3 * (1.0 - 1.0 / 60.0) ** 30, abs=2e-3)
    assert math.isnan(bench.records[-1]["battery_voltage"])
    assert bench.records[-1]["bus_current"] == 0.0
