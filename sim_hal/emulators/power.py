"""The simulated power system, and the solar strings of a body in orbit with the converters that measure them.

Battery, solar panels and loads are on one unregulated bus, with two monitors. Each load draws constant power,
so the bus current depends on the bus voltage. The power of the panels is proportional to the cosine of the
angle of incidence and to the visible fraction of the Sun's disc; light from the Earth is neglected. A full
battery accepts no current. An empty battery keeps the voltage of an empty cell, because the simulated board
cannot lose its supply.

A solar string is a group of cells in series on one face of the body. The currents are computed from sunlight,
sunlight reflected by the Earth, shadow, and the errors of the cells. The reflected light is summed over the
visible ground, which is Lambertian and has a uniform albedo. The default albedo of 0.3 is close to the
Earth's mean of 0.29 (Stephens et al. 2015, Rev. Geophys. 53).

The emulated ADS1115 has the registers Config and Conversion and the conversion times of the data sheet (TI
SBAS444, Table 8-3). The emulated ADS1115 converts single-ended inputs in single-shot mode, which the driver
uses. Other settings of the register Config are stored, but start no conversion. A conversion returns the
voltage at the end of the conversion time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np

from flight.schema.devices import Battery
from flight.schema.document import ConfigError
from hal.drivers.current_monitors import StringWiring
from hal.interfaces.errors import check_limits
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray, tangent_basis
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, sunlit_share
from knightcube.astro.quaternion import attitude_matrix
from knightcube.compiled import compiled_form_of, loop_helper
from sim_hal.emulators.camera import EmulatedCamera
from sim_hal.settings import PowerTruth
from sim_hal.worlds.world import OrbitingWorld

PERIOD_NS = 250_000_000
"""Time step (ns) of the power system, less than the recording time of the coils' supply current."""
FRAME_POWER = 1.0
"""Power (W) that star camera and processing draw after a frame until the energy per frame is used up."""
Supply = Callable[[int, int], tuple[float, float]]
"""Function from start and end of a time window (ns) to the coils' mean supply voltage (V) and current (A)."""


class Rail:
    """A measured supply line, with voltage (V) and current (A).

    Attributes:
        stuck: whether a fault holds the measured values constant.
        gain: gain of the measured values, which a fault sets to a value other than 1.
        monitor, bus: emulated current monitor, and the I2C bus to which it is connected.
    """

    def __init__(self) -> None:
        self.values = (0.0, 0.0)
        self.stuck = False
        self.gain = 1.0
        self.monitor: Any = None
        self.bus: Any = None
        self._shown = (0.0, 0.0)

    def measure(self, *_: int) -> tuple[float, float]:
        """Return the measured voltage (V) and current (A), which do not depend on the time window."""
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
        lost_panel: number of the failed panel, 0 if all panels have failed, or None if no panel has failed.
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
        """Connect battery, panels and loads. Raises ConfigError if the normal of a panel is zero."""
        self._battery = truth.battery or battery
        self._truth, self._world, self._supply, self._camera = truth, world, supply, camera
        self.charge = truth.charge
        self.rails = (Rail(), Rail())
        self.cells_lost, self.weakness = 0, 1.0
        self.lost_panel: int | None = None
        for number, panel in enumerate(truth.panels):
            if not any(panel.normal):
                key = f"simulation.power.panels[{number}].normal"
                raise ConfigError(key, "has length 0: give the outward normal of the panel")
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


DEVICE = "solar strings"
LAMP = 0.2
"""Irradiance of a halogen lamp at a short distance, relative to sunlight."""
_RINGS, _SPOKES = 16, 32
"""Numbers of rings and of radial directions of the sampling points on the visible ground."""
_DISTANCE_STEP = 100.0
"""Step (m) to which the distance from the Earth's centre is rounded when the visible ground is computed.

The rounding changes the reflected light by less than 0.02 %.
"""


@dataclass(frozen=True, slots=True, eq=False)
class SolarCellsModel:
    """Properties of n solar strings.

    Attributes:
        normals: outward unit vectors (n, 3) of the strings' faces, body axes.
        peaks: nominal currents (n,) at normal incidence and one astronomical unit, A.
        gain_errors: relative errors (n,) of the peak currents.
        grazing: angle (rad) between light and surface below which the reflected fraction of the light
            increases.
        noise: standard deviation of the current noise, A.
        albedo: reflectance (albedo) of the Earth, from 0 to 1.
    """

    normals: FloatArray
    peaks: FloatArray
    gain_errors: FloatArray
    grazing: float = math.radians(5.0)
    noise: float = 2e-3
    albedo: float = 0.3

    def __post_init__(self) -> None:
        count = len(self.normals)
        if np.shape(self.normals) != (count, 3) or np.shape(self.peaks) != (count,):
            raise ValueError(f"{DEVICE}: give normals (n, 3) and peaks (n,)")
        if np.shape(self.gain_errors) != (count,):
            raise ValueError(f"{DEVICE}: give one gain error per string")
        limits = {"grazing": (0.0, 0.5, "rad"), "noise": (0.0, 10.0, "A"), "albedo": (0.0, 1.0, "")}
        check_limits(DEVICE, self, limits)

    def currents(
        self, position: FloatArray, sun: FloatArray, body: FloatArray, generator: np.random.Generator
    ) -> FloatArray:
        """Return the currents (n,), A, of the solar strings.

        `position` (3,) and the Sun's position `sun` (3,) are geocentric, m, ICRS. `body` (3, 3) is the
        attitude matrix, ICRS into body axes.
        """
        to_sun = sun - position
        distance = float(np.linalg.norm(to_sun))
        light = float(sunlit_share(position, sun)) * (ASTRONOMICAL_UNIT / distance) ** 2
        return self.currents_in_light(position, to_sun / distance, light, body, generator)

    def currents_in_light(
        self,
        position: FloatArray,
        to_sun: FloatArray,
        light: float,
        body: FloatArray,
        generator: np.random.Generator,
    ) -> FloatArray:
        """Return the currents (n,), A, as `currents` does, in sunlight of known direction and intensity.

        `to_sun` (3,) is the direction to the Sun, ICRS, and `light` the intensity of the sunlight relative to
        that at one astronomical unit, 0 in the umbra.
        """
        distance = math.hypot(*position.tolist())
        rays, ground, solid = _ground_in_view(round(distance / _DISTANCE_STEP))
        local = np.empty((3, 3))
        local[2] = position / -distance
        local[:2] = tangent_basis(local[2].tolist())
        place = local, to_sun, light, rays, ground, self.albedo / math.pi * solid
        return self._produced(_irradiance(self.normals.dot(body), *place, math.sin(self.grazing)), generator)

    def in_lamplight(self, lamp: FloatArray, generator: np.random.Generator) -> FloatArray:
        """Return the currents (n,), A, while a lamp shines onto the panel with the normal `lamp` (3,)."""
        lit = np.asarray(self.normals @ lamp > math.cos(math.radians(5.0)), dtype=float)
        return self._produced(LAMP * lit, generator)

    def _produced(self, light: FloatArray, generator: np.random.Generator) -> FloatArray:
        """Return the currents (n,), A, for irradiances (n,) relative to sunlight at normal incidence."""
        noise = self.noise * generator.standard_normal(len(self.peaks))
        # The diode of a solar string blocks reverse current.
        return np.asarray(np.maximum(self.peaks * (1.0 + self.gain_errors) * light + noise, 0.0))


def _irradiance_numpy(
    normals: FloatArray,
    local: FloatArray,
    to_sun: FloatArray,
    light: float,
    rays: FloatArray,
    ground: FloatArray,
    reflected: float,
    grazing: float,
) -> FloatArray:
    """Return the irradiances (n,), as the numpy form of `_irradiance`."""

    def accepted(cosines: FloatArray) -> FloatArray:
        lit = np.maximum(cosines, 0.0)
        return np.asarray(lit * np.minimum(lit / grazing, 1.0)) if grazing > 0.0 else lit

    lit = np.maximum(ground @ (local @ to_sun), 0.0)
    return light * accepted(normals @ to_sun) + accepted(normals @ local.T @ rays.T) @ (reflected * lit)


@compiled_form_of(_irradiance_numpy)
def _irradiance(
    normals: FloatArray,
    local: FloatArray,
    to_sun: FloatArray,
    light: float,
    rays: FloatArray,
    ground: FloatArray,
    reflected: float,
    grazing: float,
) -> FloatArray:
    """Return the irradiances (n,), relative to sunlight at normal incidence, that the solar strings use.

    If the cosine of the incidence angle is below `grazing`, the used light decreases with the cosine squared.

    Args:
        normals: unit normals (n, 3) of the strings, ICRS.
        local: rotation matrix (3, 3) from ICRS to axes whose third axis points to the centre of the Earth.
        to_sun: unit vector (3,) to the Sun, ICRS.
        light: intensity of the sunlight relative to that at one astronomical unit.
        rays: directions (m, 3) to ground points in the axes of `local`.
        ground: unit verticals (m, 3) at the ground points.
        reflected: intensity of the light from each ground point if the Sun is at the zenith there.
        grazing: cosine of the incidence angle below which part of the light is reflected.
    """
    count = len(normals)
    used, turned = np.zeros(count), normals @ local.T
    x, y, z = local @ to_sun
    for i in range(count):
        used[i] = light * _used(turned[i, 0] * x + turned[i, 1] * y + turned[i, 2] * z, grazing)
    for k in range(len(rays)):
        lit = reflected * (ground[k, 0] * x + ground[k, 1] * y + ground[k, 2] * z)
        if lit > 0.0:
            right, down, ahead = rays[k]
            for i in range(count):
                cosine = turned[i, 0] * right + turned[i, 1] * down + turned[i, 2] * ahead
                used[i] += lit * _used(cosine, grazing)
    return used


@loop_helper
def _used(cosine: float, grazing: float) -> float:
    """Return the fraction of the light that a cell uses, given the cosine of the incidence angle."""
    lit = max(cosine, 0.0)
    return lit * lit / grazing if lit < grazing else lit


@lru_cache(maxsize=8)
def _ground_in_view(steps: int) -> tuple[FloatArray, FloatArray, float]:
    """Return directions (m, 3) to ground points, unit verticals (m, 3) there, and each point's solid angle.

    The distance from the centre of the Earth is `steps` times `_DISTANCE_STEP`. The third axis of the vectors
    points to the centre of the Earth. The directions sample the visible disc of the Earth in rings of equal
    solid angle. The returned solid angle (sr) is that part of the disc which each direction represents.
    """
    distance = steps * _DISTANCE_STEP
    widest = math.sqrt(1.0 - (EARTH_RADIUS / distance) ** 2)
    cosine = 1.0 - (np.arange(_RINGS) + 0.5) / _RINGS * (1.0 - widest)
    sine = np.sqrt(1.0 - cosine**2)
    angle = np.arange(_SPOKES) * (2.0 * np.pi / _SPOKES)
    rays = np.empty((_RINGS, _SPOKES, 3))
    rays[..., 0], rays[..., 1] = np.outer(sine, np.cos(angle)), np.outer(sine, np.sin(angle))
    rays[..., 2] = cosine[:, None]
    length = distance * cosine - np.sqrt(EARTH_RADIUS**2 - (distance * sine) ** 2)
    ground = (length[:, None, None] * rays - [0.0, 0.0, distance]) / EARTH_RADIUS
    return rays.reshape(-1, 3), ground.reshape(-1, 3), 2.0 * np.pi * (1.0 - widest) / (_RINGS * _SPOKES)


CONVERSION, CONFIG = 0x00, 0x01
_GENERAL_CALL, _RESET = 0x00, b"\x06"
POWER_ON_CONFIG = 0x8583
_START = 0x8000
_SINGLE_SHOT = 0x0100
_FULL_SCALE = (6.144, 4.096, 2.048, 1.024, 0.512, 0.256, 0.256, 0.256)
_RATES = (8, 16, 32, 64, 128, 250, 475, 860)


class EmulatedAds1115:
    """An emulated ADS1115; the function `measure(channel)` returns the present voltage at an input."""

    def __init__(self, address: int, now_ns: Callable[[], int], measure: Callable[[int], float]) -> None:
        self.address = address
        self._now_ns, self._measure = now_ns, measure
        self.brown_out()

    def brown_out(self) -> None:
        """Return to the power-on state."""
        self._pointer = CONVERSION
        self._config = POWER_ON_CONFIG & ~_START
        self._conversion = 0
        self._ready_ns = self._now_ns()
        self._converting = False

    def answers(self, address: int) -> bool:
        """Return whether the address is the converter's own address or the general call."""
        return address in {_GENERAL_CALL, self.address}

    def write(self, address: int, data: bytes) -> None:
        """Store a register pointer, and a word for the register Config; thresholds are not modelled.

        The reset by general call restores the power-on state (TI SBAS444, section 9.5.1.2).
        """
        if address == _GENERAL_CALL:
            if data == _RESET:
                self.brown_out()
            return
        self._complete()
        self._pointer = data[0] & 0b11
        if len(data) >= 3 and self._pointer == CONFIG:
            word = data[1] << 8 | data[2]
            self._config = word & ~_START
            if word & _START and word & _SINGLE_SHOT:
                self._converting = True
                self._ready_ns = self._now_ns() + 1_000_000_000 // _RATES[word >> 5 & 0b111]

    def read(self, count: int) -> bytes:
        """Return `count` bytes, which repeat the two bytes of the selected register."""
        self._complete()
        word = self._conversion if self._pointer == CONVERSION else self._config
        if self._pointer == CONFIG and not self._converting:
            word |= _START
        return (word.to_bytes(2, "big") * (count // 2 + 1))[:count]

    def _complete(self) -> None:
        """Store the result of the running conversion if its conversion time has elapsed."""
        if not self._converting or self._now_ns() < self._ready_ns:
            return
        self._converting = False
        mux = self._config >> 12 & 0b111
        volts = self._measure(mux & 0b11) if mux & 0b100 else 0.0
        counts = round(volts / _FULL_SCALE[self._config >> 9 & 0b111] * 32_768)
        self._conversion = min(0x7FFF, max(-0x8000, counts)) & 0xFFFF


_FRESH_NS = 20_000_000
"""Time (ns) after which the cached currents of the solar strings are computed again."""


class EmulatedSolarCells:
    """The n emulated solar strings and the analogue-to-digital converters that measure their currents.

    Attributes:
        parts: the emulated ADS1115 converters.
        dead: mask (n,) of the failed strings, which give no current.
        frozen: whether a fault holds all currents constant.
        gain: gain of all amplifiers relative to the nominal gain.
        lamp: outward normal (3,), body axes, of the panel that a lamp on a bench illuminates; None in flight.
    """

    def __init__(
        self,
        world: OrbitingWorld,
        model: SolarCellsModel,
        wirings: Sequence[StringWiring],
        now_ns: Callable[[], int],
        generator: np.random.Generator,
    ) -> None:
        self.dead = np.zeros(len(wirings), dtype=bool)
        self.frozen = False
        self.gain = 1.0
        self.lamp: FloatArray | None = None
        self._world, self._model, self._now_ns, self._generator = world, model, now_ns, generator
        self._strings = {(w.address, w.channel): (i, w.volt_per_ampere) for i, w in enumerate(wirings)}
        self._currents: FloatArray = np.zeros(len(wirings))
        self._measured_ns = -_FRESH_NS
        self.parts = tuple(
            EmulatedAds1115(address, now_ns, partial(self._voltage, address))
            for address in sorted({wiring.address for wiring in wirings})
        )

    def _voltage(self, address: int, channel: int) -> float:
        """Return the voltage (V) at the input of a converter."""
        index, volt_per_ampere = self._strings.get((address, channel), (None, 0.0))
        if index is None:
            return 0.0
        now_ns = self._now_ns()
        if not self.frozen and now_ns - self._measured_ns >= _FRESH_NS:
            self._measured_ns = now_ns
            self._currents = self._light(now_ns)
        return 0.0 if self.dead[index] else volt_per_ampere * self.gain * float(self._currents[index])

    def _light(self, now_ns: int) -> FloatArray:
        if self.lamp is not None:
            return self._model.in_lamplight(self.lamp, self._generator)
        body = quaternion.attitude_matrix(self._world.motion(now_ns).quaternion)
        around = self._world.surroundings()
        position, to_sun = np.array(around.position), np.array(around.sun)
        return self._model.currents_in_light(position, to_sun, around.light, body, self._generator)
