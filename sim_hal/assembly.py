"""Builds the simulated hardware of a configuration: the world and the emulated devices in it.

The devices offer the same Protocols as the devices on Linux, so simulated flights exercise the flight
drivers. Until its release the body is held still at its initial attitude.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from flight.schema.devices import Camera
from flight.schema.sections import Config
from hal.drivers.coils import CoilSettings, wirings
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.catalogue import load
from sim_hal.clock import EmulatedDevice, FaultTimeline, SerialEnd, TimedSimulation
from sim_hal.emulators.camera import EmulatedCamera, Expose
from sim_hal.emulators.coil_circuit import CoilCircuit
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from sim_hal.emulators.ina219 import EmulatedIna219
from sim_hal.emulators.pca9685 import EmulatedPca9685
from sim_hal.emulators.vn100 import Vn100Emulator, Vn100EmulatorSettings
from sim_hal.emulators.vn100_sensors import PROFILES, NoiseProfile
from sim_hal.objects import Objects
from sim_hal.orbit_devices import ExposeWide, OrbitDevices, wanted
from sim_hal.orbit_sky import from_orbit
from sim_hal.settings import Simulation, SkySection
from sim_hal.worlds.world import BodyMotion, OrbitingWorld, TruthRecorder, World, WorldInputs, make_world

if TYPE_CHECKING:
    from sim_hal.star_camera import SourceTrack, StarCameraModel


BUS_VOLTAGE = 5.0
"""V in the coils' supply, before the losses of the bridge [ch. 5: a 5 V power bus]."""


@dataclass(frozen=True, slots=True)
class CoilHardware:
    """The parts on the I2C bus and the circuit behind them; a configuration may have no monitor."""

    bus: EmulatedI2cBus
    pwm: EmulatedPca9685
    monitor: EmulatedIna219 | None
    circuit: CoilCircuit


def assemble_coils(
    config: Config,
    section: Simulation,
    generator: np.random.Generator,
    now_ns: Callable[[], int],
    wait: Callable[[int], None] | None = None,
) -> CoilHardware:
    """Build the coils; `now_ns` returns the simulation's time, `wait` advances time while the bus hangs."""
    pwm = EmulatedPca9685(config.coils.address, now_ns)
    circuit = CoilCircuit(
        pwm,
        _coil_settings(config, section),
        generator,
        now_ns,
        uncertainty=section.current_noise,
        bus_voltage=BUS_VOLTAGE,
    )
    settings = config.power_monitor
    monitor = None
    if settings is not None:
        monitor = EmulatedIna219(settings.address, now_ns, circuit.mean_supply, settings.shunt)
    bus = EmulatedI2cBus([pwm] if monitor is None else [pwm, monitor], wait=wait)
    return CoilHardware(bus, pwm, monitor, circuit)


def _coil_settings(config: Config, section: Simulation) -> CoilSettings:
    """Return the true coil settings."""
    coils = config.coils
    resistance = section.truth.resistance or coils.resistance
    supply = section.truth.supply_voltage or coils.supply_voltage
    wired = wirings(coils.channels, resistance, coils.signs)
    return CoilSettings(wired, supply, coils.current_limit, coils.stale_after)


_LINE_STREAM = 0x11E
_FAULT_STREAM = 0xFA017


@dataclass(frozen=True, slots=True)
class Hardware:
    """All simulated parts. Drivers use `bus` and `camera`; faults and tests use the rest."""

    simulation: TimedSimulation
    world: World
    unit: Vn100Emulator
    bus: EmulatedI2cBus
    pwm: EmulatedPca9685
    monitor: EmulatedIna219 | None
    circuit: CoilCircuit
    camera: EmulatedCamera | None
    truth: TruthRecorder | None
    faults: FaultTimeline
    orbit: OrbitDevices
    objects: Objects

    def release(self, epoch_ns: int) -> None:
        """Release the body at `epoch_ns`, mission time zero."""
        self.world.release_at(epoch_ns)
        self.objects.begin(epoch_ns)
        if self.truth is not None:
            self.truth.begin(epoch_ns)


def assemble(
    config: Config,
    section: Simulation,
    now_ns: Callable[[], int],
    line: SerialEnd,
    truth: TruthRecorder | None = None,
    expose: Expose | None = None,
    wait: Callable[[int], None] | None = None,
    gps_line: SerialEnd | None = None,
    expose_wide: ExposeWide | None = None,
) -> Hardware:
    """Build the hardware of `config` in the world of its simulation `section`.

    `now_ns` returns the simulation's time; `line` and `gps_line` are the device ends of the serial lines;
    `expose` and `expose_wide` replace the cameras' renderers (in real time a process of its own); `wait`
    advances time while the bus hangs. Raises ConfigError for a world that cannot be made.
    """
    unit_seed, circuit_seed = np.random.SeedSequence(section.seed).spawn(2)
    coils = assemble_coils(config, section, np.random.default_rng(circuit_seed), now_ns, wait)
    circuit = coils.circuit
    world = make_world(WorldInputs(config, section, circuit.currents, now_ns()))
    sense = _sense(world, circuit, np.array(section.coil_field), np.array(section.imu.field_bias))
    free_fall = isinstance(world, OrbitingWorld)
    unit = _unit(config, section, sense, line, np.random.default_rng(unit_seed), now_ns(), free_fall)
    objects = Objects(section.objects, section.utc, now_ns(), world)
    camera = _camera(config.camera, section, world, expose, now_ns, objects)
    orbit = _orbit(config, section, world, now_ns, gps_line, expose_wide)
    for part in orbit.cells.parts if orbit.cells is not None else ():
        coils.bus.attach(part)
    faults = FaultTimeline()
    if truth is not None:
        truth.watch(world)
    # At equal times devices run in this order.
    devices: list[EmulatedDevice | None] = [unit, camera, orbit.gps, *orbit.wide, faults, truth]
    simulation = TimedSimulation(world.advance_to, [device for device in devices if device is not None])
    parts = (unit, coils.bus, coils.pwm, coils.monitor, circuit, camera, truth, faults, orbit, objects)
    return Hardware(simulation, world, *parts)


def _sense(
    world: World, circuit: CoilCircuit, coil_field: FloatArray, bias: FloatArray
) -> Callable[[int], BodyMotion]:
    """Return the motion that the inertial unit measures, with the coils' field and the magnetometer's bias.

    `coil_field` is (3, 3) T/A, `bias` (3,) T, body axes.

    The mean currents count: the unit averages its magnetometer over one control period.
    """
    if not (coil_field.any() or bias.any()):
        return world.motion

    def sense(time_ns: int) -> BodyMotion:
        motion = world.motion(time_ns)
        return replace(motion, field_body=motion.field_body + coil_field @ circuit.currents() + bias)

    return sense


def _unit(
    config: Config,
    section: Simulation,
    sense: Callable[[int], BodyMotion],
    line: SerialEnd,
    generator: np.random.Generator,
    now_ns: int,
    free_fall: bool,
) -> Vn100Emulator:
    imu = section.imu
    profile = NoiseProfile() if imu.profile == "bounds" else PROFILES[imu.profile]
    settings = Vn100EmulatorSettings(
        noise=replace(profile, attitude_bound=imu.quaternion_noise, rate_bound=imu.rate_noise),
        mounting=np.array(config.inertial_unit.mounting),
        gyro_bias=np.array(imu.gyro_bias),
        clock_ppm=imu.clock_ppm,
        free_fall=free_fall,
    )
    return Vn100Emulator(sense, line, generator, settings, now_ns=now_ns)


def _camera(
    camera: Camera | None,
    section: Simulation,
    world: World,
    expose: Expose | None,
    now_ns: Callable[[], int],
    objects: Objects,
) -> EmulatedCamera | None:
    if camera is None:
        return None
    make = expose or inline_exposure(StarRenderer(camera, section.sky, section.seed))
    if isinstance(world, OrbitingWorld):
        make = from_orbit(make, world, camera)
    readout_ns = round(section.sky.readout * 1e9)
    scan_ns = round(section.sky.line_time * camera.rows * 1e9)
    mounting = np.array(camera.mounting)
    return EmulatedCamera(world.motion, make, now_ns, readout_ns, mounting, scan_ns, objects.tracks)


def _orbit(
    config: Config,
    section: Simulation,
    world: World,
    now_ns: Callable[[], int],
    line: SerialEnd | None,
    expose: ExposeWide | None,
) -> OrbitDevices:
    if not wanted(config):
        return OrbitDevices()
    from sim_hal.orbit_assembly import assemble_orbit  # noqa: PLC0415 - see `orbit_devices`

    return assemble_orbit(config, section, world, now_ns, line, expose)


def line_generator(seed: int, *line: int) -> np.random.Generator:
    """Return the generator of a serial line's faults, independent of all others of the same seed."""
    return np.random.default_rng([seed, _LINE_STREAM, *line])


def fault_generator(seed: int) -> np.random.Generator:
    """Return the generator of device faults, independent of all others of the same seed."""
    return np.random.default_rng([seed, _FAULT_STREAM])


def camera_model(camera: Camera, sky: SkySection) -> StarCameraModel:
    """Return the optics and detector of an emulated camera."""
    # Imported late: half of a server's start-up time, and another process renders its frames.
    from sim_hal.star_camera import StarCameraModel  # noqa: PLC0415

    return StarCameraModel(
        columns=camera.columns,
        rows=camera.rows,
        field_of_view=float(np.deg2rad(camera.field_of_view_deg)),
        aperture=sky.aperture,
        read_noise=camera.read_noise,
        dark_current=sky.dark_current,
        gain=camera.gain,
        pedestal=sky.pedestal,
        bits=camera.bits,
        full_well=sky.full_well,
        psf_sigma=camera.psf_sigma,
        line_time=sky.line_time,
        psf=sky.psf,
        noise=sky.noise,
    )


class StarRenderer:
    """Renders the frames of one camera; the noise of frame k depends on the seed and k only."""

    def __init__(self, camera: Camera, sky: SkySection, seed: int) -> None:
        self._model = camera_model(camera, sky)
        catalogue = load().brighter_than(sky.magnitude_limit)
        self._directions = catalogue.directions_at(sky.year)
        self._magnitudes = catalogue.magnitude
        self._seed = seed

    def render(
        self, sequence: int, times: FloatArray, attitudes: FloatArray, tracks: Sequence[SourceTrack] = ()
    ) -> Image:
        """Return frame `sequence`, exposed along `attitudes` (k, 4) at `times` (k,) s."""
        from sim_hal.star_camera import render  # noqa: PLC0415 - see `camera_model`

        generator = np.random.default_rng([self._seed, sequence])
        return render(self._model, self._directions, self._magnitudes, times, attitudes, generator, tracks)


def inline_exposure(renderer: StarRenderer) -> Expose:
    """Return an exposure that renders at once, for lock-step."""

    def expose(
        sequence: int, times: FloatArray, attitudes: FloatArray, tracks: Sequence[SourceTrack]
    ) -> Future[Image]:
        future: Future[Image] = Future()
        future.set_result(renderer.render(sequence, times, attitudes, tracks))
        return future

    return expose
