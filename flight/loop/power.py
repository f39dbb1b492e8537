"""Power system: estimates the state of charge of the battery, and sheds loads while the battery is low.

The state of charge is the integral of the measured current, which is slowly corrected towards the state of
charge that follows from voltage, current and internal resistance. If the current monitor of the battery
cannot be trusted, the state of charge follows from the voltage of the bus. If no monitor can be trusted, the
state of charge is unknown, and no load is shed or switched on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flight.link.telemetry.definitions import POWER
from flight.loop import facts
from flight.loop.facts import Services
from flight.schema.devices import Battery, Power
from hal.interfaces.devices import PowerMonitor, PowerReading

CORRECTION_TIME = 1800.0
"""Time constant (s) with which the voltage corrects the state of charge that follows from the integrated
current."""
VOLTAGE_TIME = 60.0
"""Time constant (s) of the correction by the voltage if the battery's current is unknown, or if the
integrated current contradicts the voltage."""
CONTRADICTION = 0.25
"""Largest accepted difference between the integrated state of charge and the state of charge from the
voltage. Beyond this difference, the value from the voltage is used."""
LONGEST_STEP = 5.0
"""Longest time (s) over which one current is integrated, and largest age (s) of a reading."""
STUCK_FOR, STUCK_RANGE = 10.0, 0.02
"""A monitor counts as stuck if its reading does not change for `STUCK_FOR` s, while the voltage of the other
monitor changes by `STUCK_RANGE` V. Both monitors measure the same voltage, and 0.02 V are five steps of the
analogue-to-digital converter."""
CELL_RANGE = (1.0, 4.6)
"""Range (V) of the voltage of a cell, outside which a reading is wrong."""
DIFFERENCE = 0.1
"""Largest accepted difference (V per cell) between the measured voltages of battery and bus."""


class ChargeEstimate:
    """The estimated state of charge of a battery, from 0 to 1, or NaN before the first reading."""

    def __init__(self, battery: Battery) -> None:
        self._battery = battery
        self.charge = math.nan

    def update(self, voltage: float, current: float, seconds: float, time_constant: float) -> None:
        """Update the charge from voltage (V) and discharge current (A), `seconds` s after the last update."""
        battery = self._battery
        measured = battery.charge(voltage + battery.resistance * current)
        if math.isnan(self.charge):
            self.charge = measured
            return
        self.charge -= current * min(seconds, LONGEST_STEP) / (3600.0 * battery.capacity)
        if abs(measured - self.charge) > CONTRADICTION:
            time_constant = VOLTAGE_TIME
        self.charge += min(seconds / time_constant, 1.0) * (measured - self.charge)
        self.charge = min(max(self.charge, 0.0), 1.0)


class MonitorWatch:
    """Checks the readings of one monitor by its errors, its range and the voltage of the other monitor."""

    def __init__(self, name: str, monitor: PowerMonitor, cells: int) -> None:
        self.name, self._monitor = name, monitor
        self._range = (cells * CELL_RANGE[0], cells * CELL_RANGE[1])
        self._last = (math.nan, math.nan)
        self._since_ns = 0
        self._low, self._high = math.inf, -math.inf  # range of the other monitor's voltage since `_since_ns`

    def read(self, now_ns: int) -> tuple[PowerReading | None, str]:
        """Return the newest reading, or None and the reason if it cannot be used."""
        reading, error = self._monitor.latest(), self._monitor.error()
        if error or reading is None:
            return None, f"{self.name}: {error or 'no reading yet'}"
        if now_ns - reading.time_ns > LONGEST_STEP * 1e9:
            return None, f"{self.name}: no reading for {(now_ns - reading.time_ns) * 1e-9:.0f} s"
        low, high = self._range
        if not low <= reading.voltage <= high:
            wrong = f"{reading.voltage:.2f} V, possible are {low:g} to {high:g} V"
            return None, f"{self.name}: {wrong}"
        return reading, ""

    def stuck(self, reading: PowerReading, other: PowerReading | None, now_ns: int) -> str:
        """Return why a reading is stuck, given the other monitor's reading, or an empty text."""
        values = (reading.voltage, reading.current)
        if values != self._last:
            self._last, self._since_ns = values, now_ns
            self._low, self._high = math.inf, -math.inf
        if other is not None:
            self._low, self._high = min(self._low, other.voltage), max(self._high, other.voltage)
        seconds, moved = (now_ns - self._since_ns) * 1e-9, self._high - self._low
        if seconds < STUCK_FOR or moved <= STUCK_RANGE:
            return ""
        return f"{self.name}: unchanged for {seconds:.0f} s, while the other monitor changed by {moved:.3f} V"


@dataclass(frozen=True, slots=True)
class Sheddable:
    """Loads that are reduced while the battery is low.

    `limit_coils` sets the fraction of the current limits that the coils may use. `rest_camera` sets the
    minimum time (s) between two frames of the star camera.
    """

    limit_coils: Callable[[float], None]
    rest_camera: Callable[[float], None]


class PowerTask:
    """Task of the housekeeping rate group that estimates the state of charge, and sheds loads."""

    def __init__(
        self, section: Power, monitors: Sequence[PowerMonitor], loads: Sheddable, services: Services
    ) -> None:
        """Use the monitors of the battery and, if fitted, of the bus."""
        self._section, self._loads, self._facts = section, loads, services.facts
        self._recorder = services.recorder
        names, cells = ("battery monitor", "bus monitor"), section.battery.cells
        self._watches = [MonitorWatch(name, one, cells) for name, one in zip(names, monitors, strict=False)]
        self._estimate = ChargeEstimate(section.battery)
        self._updated_ns = 0
        self._energy = [0.0, 0.0]  # energy (J) into and out of the battery
        self._lowest = math.inf
        self._shed = 0

    def begin(self, time_ns: int) -> None:
        """Integrate the current from `time_ns` on."""
        self._updated_ns = time_ns

    def run(self, now_ns: int) -> None:
        """Read the monitors, update the state of charge, and shed loads; called once a second."""
        battery, bus = self._read(now_ns)
        seconds = (now_ns - self._updated_ns) * 1e-9
        known = battery is not None or bus is not None
        if battery is not None:
            self._estimate.update(battery.voltage, battery.current, seconds, CORRECTION_TIME)
            energy = battery.power * min(seconds, LONGEST_STEP)
            self._energy[energy > 0.0] += abs(energy)
        elif bus is not None:
            # The current of the panels is unknown: the battery is assumed to supply all loads.
            self._estimate.update(bus.voltage, bus.current, seconds, VOLTAGE_TIME)
        self._updated_ns = now_ns if known else self._updated_ns
        charge = self._estimate.charge if known else math.nan
        self._lowest = min(self._lowest, charge) if known else self._lowest
        self._judge(charge, now_ns)
        self._recorder.record(
            POWER,
            now_ns,
            shed=self._shed,
            charge=charge,
            battery_voltage=math.nan if battery is None else battery.voltage,
            battery_current=math.nan if battery is None else battery.current,
            bus_voltage=math.nan if bus is None else bus.voltage,
            bus_current=math.nan if bus is None else bus.current,
            energy_in=self._energy[0],
            energy_out=self._energy[1],
        )

    def summary(self) -> str:
        """Return state of charge and energies as text, for the end of a flight."""
        if math.isnan(self._estimate.charge):
            return "state of charge unknown"
        gained, used = self._energy
        return (
            f"state of charge {100.0 * self._estimate.charge:.1f} %, at least {100.0 * self._lowest:.1f} %; "
            f"{gained:.1f} J into and {used:.1f} J out of the battery"
        )

    def _read(self, now_ns: int) -> tuple[PowerReading | None, PowerReading | None]:
        """Return the trusted readings of battery and bus, and report monitors that cannot be trusted."""
        read = [watch.read(now_ns) for watch in self._watches]
        found, texts = [one for one, _ in read], [text for _, text in read]
        if len(found) == 2:
            for watch, one, other, index in zip(self._watches, found, found[::-1], range(2), strict=True):
                if one is not None:
                    texts[index] = watch.stuck(one, other, now_ns)
            if all(one is not None for one in found) and not any(texts):
                texts = [self._contradiction(*found)] * 2
        for fact, text in zip((facts.BATTERY_MONITOR_LOST, facts.BUS_MONITOR_LOST), texts, strict=False):
            self._facts.update(fact, bool(text), now_ns, text or "the readings are used again")
        trusted = [None if text else one for one, text in zip(found, texts, strict=True)]
        return trusted[0], trusted[1] if len(trusted) == 2 else None

    def _contradiction(self, battery: PowerReading | None, bus: PowerReading | None) -> str:
        assert battery is not None
        assert bus is not None
        if abs(battery.voltage - bus.voltage) <= DIFFERENCE * self._section.battery.cells:
            return ""
        return f"the battery monitor shows {battery.voltage:.2f} V, the bus monitor {bus.voltage:.2f} V"

    def _judge(self, charge: float, now_ns: int) -> None:
        """Update the monitored conditions about the battery, and shed loads or switch them on again."""
        limits = self._section.low_battery
        levels = (
            (facts.BATTERY_LOW, limits.low),
            (facts.BATTERY_VERY_LOW, limits.very_low),
            (facts.BATTERY_CRITICAL, limits.critical),
        )
        shed = 0
        for number, (fact, limit) in enumerate(levels, start=1):
            bound = limit + limits.hysteresis if self._facts.holds(fact) else limit
            holds = None if math.isnan(charge) else charge < bound
            text = f"state of charge {100.0 * charge:.0f} %, limit {100.0 * bound:.0f} %"
            text = text if holds else f"no longer {fact.name}: {text}"
            self._facts.update(fact, holds, now_ns, text)
            shed = number if self._facts.holds(fact) else shed
        if shed != self._shed:
            self._shed = shed
            self._loads.limit_coils(limits.coil_share if shed >= 1 else 1.0)
            self._loads.rest_camera(limits.camera_period if shed >= 2 else 0.0)
