"""Tests of the power system: battery, panels, current monitors and the power task.

Battery, panels, emulated monitors and the power task run on a simulated clock, without a flight. The true
battery has 10 % less capacity, 30 % more resistance and a slightly different curve than the configured
battery.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.link.events import Mode
from flight.link.telemetry.definitions import POWER
from flight.loop.power import PowerTask, Sheddable
from flight.schema.devices import Battery, Power
from flight.schema.document import ConfigError
from flight.schema.sections import Modes
from hal.drivers.current_monitors import Ina219
from knightcube.astro.arrays import FloatArray
from sim_hal.clock import SimClock, TimedSimulation
from sim_hal.emulators.coil_circuit import EmulatedIna219
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from sim_hal.emulators.power import EmulatedPower
from sim_hal.faults.catalogue import CATALOGUE
from sim_hal.settings import PowerTruth, SolarPanel
from tests.flight.loop.mode_bench import SATELLITE, ModeBench

SECOND_NS = 1_000_000_000
CURVE = (3.05, 3.44, 3.56, 3.61, 3.64, 3.71, 3.77, 3.88, 3.95, 4.07, 4.17)
SECTION = Power(battery=Battery(capacity=0.06))
TRUTH = PowerTruth(
    charge=0.55,
    battery=Battery(capacity=0.054, resistance=0.13, open_circuit=CURVE),
    load=1.2,
    panels=tuple(SolarPanel(normal=normal, peak=9.0) for normal in ((2.0, 0.0, 0.0), (0.0, 1.0, 0.0))),
)
SUNRISE, END = 320.0, 620.0
FULL_COILS = 0.45
"""Supply current (A) of the coils at their limits, at 5 V."""


class Satellite:
    """A power system with its monitors and task, coils that obey the current limit, and a mode control."""

    def __init__(self, charge: float = TRUTH.charge) -> None:
        self.clock = SimClock()
        self.modes = ModeBench(SATELLITE, Modes(initial="safe"))
        self.share, self.rest = 1.0, 0.0
        self.rows: list[dict[str, float]] = []
        self.true: list[dict[str, float]] = []
        world = SimpleNamespace(
            motion=lambda _: SimpleNamespace(quaternion=np.array([0.0, 0.0, 0.0, 1.0])),
            surroundings=lambda: SimpleNamespace(sun=(0.6, -0.8, 0.0), light=float(self.seconds >= SUNRISE)),
        )
        truth = TRUTH if charge == TRUTH.charge else PowerTruth(charge=charge, load=TRUTH.load)
        self.power = EmulatedPower(
            SECTION.battery, truth, cast(Any, world), lambda *_: (5.0, self.share * FULL_COILS), None, 0
        )
        bus = EmulatedI2cBus()
        self.clock.attach(TimedSimulation(lambda _: None, [self.power]))
        monitors = []
        for rail, section in zip(self.power.rails, SECTION.monitors().values(), strict=True):
            rail.monitor = EmulatedIna219(section.address, self.clock.now_ns, rail.measure, section.shunt)
            rail.bus = bus
            bus.attach(rail.monitor)
            monitors.append(Ina219(bus, section.address, self.clock, maximum_current=2.0))
        recorder = SimpleNamespace(record=self._record)
        services = SimpleNamespace(facts=self.modes.facts, recorder=recorder)
        self.task = PowerTask(SECTION, monitors, Sheddable(self._limit, self._rest), cast(Any, services))

    @property
    def seconds(self) -> float:
        return self.clock.now_ns() * 1e-9

    def fly(self, end: float, *faults: tuple[float, str]) -> None:
        """Run the task once a second until `end` s. Each fault begins at its given time."""
        due = dict(faults)
        bench: Any = SimpleNamespace(hardware=SimpleNamespace(power=self.power))
        while self.seconds < end:
            self.clock.sleep_until_ns(self.clock.now_ns() + SECOND_NS)
            if name := due.get(round(self.seconds)):
                kind = CATALOGUE[name]
                assert kind.begin is not None
                kind.begin(bench, kind, {key: one.default or 0.0 for key, one in kind.parameters.items()})
            self.true.append(dict(self.power.truth()))
            self.modes.now_ns = self.clock.now_ns()
            self.task.run(self.clock.now_ns())

    def column(self, name: str) -> FloatArray:
        return np.array([row[name] for row in self.rows])

    def names(self, *parts: str) -> list[str]:
        return [name for name in self.modes.events if name.startswith(parts)]

    def _limit(self, share: float) -> None:
        self.share = share

    def _rest(self, seconds: float) -> None:
        self.rest = seconds

    def _record(self, packet: object, _: int, **fields: float) -> None:
        assert packet is POWER
        assert set(fields) == {field.name for field in POWER.fields}
        self.rows.append({**fields, "mode": float(self.modes.control.mode), "rest": self.rest})


def pointing(satellite: Satellite) -> Satellite:
    satellite.modes.step()
    satellite.modes.control.command(Mode.POINT, 0)
    while satellite.modes.step() is not Mode.POINT:
        assert satellite.modes.now_ns < 60 * SECOND_NS
    return satellite


@pytest.fixture(scope="module")
def orbit() -> Satellite:
    """Return a satellite after an eclipse and a time in sunlight, with the largest coil currents."""
    satellite = pointing(Satellite())
    satellite.fly(END)
    return satellite


def test_a_low_battery_sheds_loads_in_order_and_the_flight_returns_after_sunrise(orbit: Satellite) -> None:
    assert orbit.names("battery", "power") == [
        "battery-low", "battery-very-low", "battery-critical",
        "battery-charged", "battery-recovered", "battery-recovered",
    ]  # fmt: skip
    shed, mode, rest = orbit.column("shed"), orbit.column("mode"), orbit.column("rest")
    begins = [int(np.flatnonzero(shed == level)[0]) for level in (1, 2, 3)]
    assert begins == sorted(begins)
    assert begins[2] < SUNRISE
    assert set(rest[shed == 1]) <= {0.0, 60.0}
    assert (rest[begins[1] + 1 : begins[2]] == 60.0).all()
    assert (mode[: begins[2] - 1] == Mode.POINT).all()
    assert (mode[begins[2] + 1 : int(SUNRISE)] == Mode.SAFE).all()
    assert mode[-1] == Mode.ACQUIRE, "the attitude is acquired again before pointing"
    assert (shed[-1], orbit.share, orbit.rest) == (0, 1.0, 0.0)


def test_limited_coils_draw_less(orbit: Satellite) -> None:
    coils, shed = np.array([one["coil_power"] for one in orbit.true]), orbit.column("shed")
    np.testing.assert_allclose(coils[10], 5.0 * FULL_COILS)
    np.testing.assert_allclose(coils[2:][shed[:-2] == 2], 0.3 * 5.0 * FULL_COILS)


def test_the_estimated_charge_follows_a_battery_unlike_the_described_one(orbit: Satellite) -> None:
    true = np.array([one["charge"] for one in orbit.true])
    assert np.abs(orbit.column("charge") - true)[5:].max() < 0.06


def test_a_panel_without_a_direction_is_refused() -> None:
    panels = (*TRUTH.panels, SolarPanel(normal=(0.0, 0.0, 0.0), peak=9.0))
    with pytest.raises(ConfigError, match=r"power\.panels\[2\]\.normal: has length 0"):
        EmulatedPower(SECTION.battery, PowerTruth(panels=panels), None, lambda *_: (5.0, 0.0), None, 0)


def test_battery_bus_and_panels_balance(orbit: Satellite) -> None:
    """The powers of battery, bus and panels balance. The lit panel receives the fraction 0.6 (cosine)."""
    lit = [one for one in orbit.true if one["solar_power"] > 0.0]
    assert lit[0]["solar_power"] == pytest.approx(9.0 * 0.6)
    for one in orbit.true[5::50]:
        balance = one["load_power"] - one["solar_power"] - one["battery_voltage"] * one["battery_current"]
        assert abs(balance) < 1e-9
    rows = orbit.rows[20:300]
    charge_used = sum(row["battery_current"] for row in rows) / 3600.0 / 0.054
    assert orbit.true[20]["charge"] - orbit.true[300]["charge"] == pytest.approx(charge_used, rel=0.01)
    assert orbit.rows[-1]["energy_in"] > orbit.rows[0]["energy_in"] == 0.0


@pytest.mark.parametrize(
    ("fault", "lost"),
    [
        ("battery-monitor: off", "battery-monitor-lost"),
        ("battery-monitor: stuck", "battery-monitor-lost"),
        ("bus-monitor: off", "bus-monitor-lost"),
        ("bus-monitor: stuck", "bus-monitor-lost"),
    ],
)
def test_a_failed_monitor_is_reported_and_the_other_one_is_used(fault: str, lost: str) -> None:
    satellite = pointing(Satellite(charge=0.8))
    satellite.fly(130.0, (40, fault))
    assert satellite.names("power") == ["power-sensor-lost"]
    assert [fact.name for fact in satellite.modes.facts.held()] == [lost]
    assert satellite.modes.control.mode is Mode.POINT
    known, true = satellite.column("charge")[-1], satellite.true[-1]["charge"]
    assert known == pytest.approx(true, abs=0.08)


@pytest.mark.parametrize("fault", ["battery-monitor: wrong", "bus-monitor: wrong"])
def test_monitors_that_contradict_each_other_shed_nothing(fault: str) -> None:
    satellite = pointing(Satellite(charge=0.8))
    satellite.fly(80.0, (40, fault))
    assert satellite.names("power", "battery") == ["power-sensor-lost"] * 2
    assert np.isnan(satellite.column("charge")[-1])
    assert satellite.modes.control.mode is Mode.POINT


def test_without_any_monitor_the_charge_is_unknown_and_nothing_changes() -> None:
    satellite = pointing(Satellite(charge=0.8))
    satellite.fly(90.0, (30, "battery-monitor: off"), (40, "bus-monitor: off"))
    assert np.isnan(satellite.column("charge")[-40:]).all()
    assert (satellite.column("shed") == 0).all()
    assert satellite.names("battery") == []


@pytest.mark.parametrize(("fault", "shed"), [("battery: cell-lost", 3), ("battery: weak", 1)])
def test_a_failing_battery_is_low(fault: str, shed: int) -> None:
    satellite = pointing(Satellite(charge=0.6))
    satellite.fly(90.0, (30, fault))
    assert satellite.column("shed")[-1] >= shed
    assert satellite.names("power") == [] or fault == "battery: cell-lost"


def test_lost_panels_give_no_power() -> None:
    satellite = Satellite()
    satellite.fly(SUNRISE + 20.0, (SUNRISE + 15.0, "panels: lost"))
    assert satellite.true[int(SUNRISE) + 10]["solar_power"] > 0.0
    assert satellite.true[-1]["solar_power"] == 0.0
