"""The simulated power system: battery, solar panels and loads on one unregulated bus, with two monitors.

Each load draws constant power, so the bus current depends on the bus voltage. The power of the panels is
proportional to the cosine of the angle of incidence and to the visible fraction of the Sun's disc; light from
the Earth is neglected. A full battery accepts no current. An empty battery keeps the voltage of an empty
cell, because the simulated board cannot lose its supply.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from flight.schema.devices import Battery
from knightcube.astro.quaternion import attitude_matrix
from sim_hal.emulators.camera import EmulatedCamera
from sim_hal.settings import PowerTruth
from sim_hal.worlds.world import OrbitingWorld

PERIOD_NS = 250_000_000
"""Period (ns) of the steps, shorter than the time over which the coils' supply current is recorded."""
FRAME_POWER = 1.0
"""Power (W) of the star camera and its processing after a frame, until the frame's energy is used up."""
Supply = Callable[[int, int], tuple[float, float]]
"""Function from start and end of a time window (ns) to the coils' mean supply voltage (V) and current (A)."""


class Rail:
    """A measured supply line, with voltage (V) and current (A).

    Attributes:
        stuck: whether a fault holds the measured values constant.
        gain: gain of the measured values, which a fault sets to a value other than 1.
        monitor: emulated current monitor, and `bus` the I2C bus to which it is connected.
    """

    def __init__(self) -> None:
        self.values = (0.0, 0.0)
        self.stuck = False
        self.gain = 1.0
        self.monitor: Any = None
        self.bus: Any = None
        self._shown = (0.0, 0.0)

    def measure(self, *_: int) -> tuple[float, float]:
        """Return the measured voltage (V) and current (A), whatever the time window."""
        if not self.stuck:
            self._shown = (self.gain * self.values[0], self.gain * self.values[1])
        return self._shown


class EmulatedPower:
    """The power system, which is an emulated device with an event every `PERIOD_NS`.

    Attributes:
        charge: state of charge, from 0 to 1.
        rails: measured supply lines of battery and bus.
        cells_lost: number of cells without voltage.
        weakness: factor by which the internal resistance is multiplied and the capacity is divided.
        lost_panel: number of the failed panel, 0 if all panels have failed, or None without a failure.
    """

    def __init__(
        self,
        battery: Battery,
        truth: PowerTruth,
        world: OrbitingWorld | None,
        supply: Supply,
        camera: EmulatedCamera | None,
        start_ns: int,
    ) -> None:
        self._battery = truth.battery or battery
        self._truth, self._world, self._supply, self._camera = truth, world, supply, camera
        self.charge = truth.charge
        self.rails = (Rail(), Rail())
        self.cells_lost, self.weakness = 0, 1.0
        self.lost_panel: int | None = None
        normals = np.array([panel.normal for panel in truth.panels]).reshape(-1, 3)
        self._normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        self._peaks = np.array([panel.peak for panel in truth.panels])
        # Number of exposures so far, and part of the frames' energy (J) that has not been drawn yet.
        self._frames, self._unused = 0, 0.0
        self._due_ns = start_ns + PERIOD_NS
        self._powers = dict.fromkeys(("solar_power", "load_power", "coil_power"), 0.0)
        self._connect(truth.load, 0.0)

    def next_event_ns(self) -> int:
        """Return the time of the next step."""
        return self._due_ns

    def advance(self, now_ns: int) -> None:
        """Advance charge, voltage and currents up to `now_ns`."""
        while self._due_ns <= now_ns:
            self._step(self._due_ns)
            self._due_ns += PERIOD_NS

    def truth(self) -> Mapping[str, float]:
        """Return the fields of the packet `true_power`."""
        voltage, current = self.rails[0].values
        return {
            "charge": self.charge, "battery_voltage": voltage, "battery_current": current, **self._powers
        }  # fmt: skip

    def _step(self, time_ns: int) -> None:
        seconds = PERIOD_NS * 1e-9
        volts, amperes = self._supply(time_ns - PERIOD_NS, time_ns)
        exposures = 0 if self._camera is None else self._camera.exposures
        self._unused += (exposures - self._frames) * self._truth.frame
        self._frames, frame = exposures, min(FRAME_POWER * seconds, self._unused)
        self._unused -= frame
        coils = volts * amperes
        load = self._truth.load + coils + frame / seconds
        solar = self._connect(load, self._solar(time_ns))
        current = self.rails[0].values[1]
        capacity = 3600.0 * self._battery.capacity / self.weakness
        self.charge = min(max(self.charge - current * seconds / capacity, 0.0), 1.0)
        self._powers = {"solar_power": solar, "load_power": load, "coil_power": coils}

    def _connect(self, load: float, solar: float) -> float:
        """Compute voltage and currents for the given powers (W), and return the used solar power, W."""
        battery, resistance = self._battery, self._battery.resistance * self.weakness
        open_circuit = battery.voltage(self.charge) * (1.0 - self.cells_lost / battery.cells)
        solar = min(solar, load) if self.charge >= 1.0 else solar
        # The current solves P = (U - R I) I; of the two solutions, the smaller one is stable.
        root = math.sqrt(max(open_circuit**2 - 4.0 * resistance * (load - solar), 0.0))
        current = (open_circuit - root) / (2.0 * resistance)
        voltage = open_circuit - resistance * current
        self.rails[0].values = (voltage, current)
        self.rails[1].values = (voltage, load / voltage if voltage > 0.0 else 0.0)
        return solar

    def _solar(self, time_ns: int) -> float:
        """Return the maximum power (W) that the panels can deliver."""
        if self._world is None or self.lost_panel == 0:
            return 0.0
        to_body = attitude_matrix(self._world.motion(time_ns).quaternion)
        around = self._world.surroundings()
        powers = self._peaks * np.maximum(self._normals @ to_body @ np.array(around.sun), 0.0)
        lost = 0.0 if self.lost_panel is None else float(powers[self.lost_panel - 1 : self.lost_panel].sum())
        return around.light * (float(powers.sum()) - lost)
