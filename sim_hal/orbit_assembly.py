"""The simulated devices of an orbit: GPS receiver, solar strings and wide cameras of a configuration."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future

import numpy as np

from flight.schema.devices import SolarStringsSection, WideCamera
from flight.schema.sections import Config
from hal.drivers.ads1115 import StringWiring
from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.lens import Lens, Pinhole
from sim_hal.clock import SerialEnd
from sim_hal.earth_camera import EarthCameraModel, EarthScene, render
from sim_hal.emulators.camera import EmulatedCamera, Expose
from sim_hal.emulators.gps import EmulatedGps, GpsErrors
from sim_hal.emulators.solar_cells import EmulatedSolarCells, SolarCellsModel
from sim_hal.orbit_devices import ExposeWide, OrbitDevices
from sim_hal.settings import OrbitDeviceTruth, Simulation
from sim_hal.worlds.orbit import sun_position
from sim_hal.worlds.world import OrbitingWorld, World, orbiting

_STREAM = 0x0B17
_UNIX_EPOCH = 2_440_587.5
_EARTH_TURN = 2.0 * math.pi * 1.002_737_909_35 / 86_400.0
READOUT_NS = 50_000_000


def assemble_orbit(
    config: Config,
    section: Simulation,
    world: World,
    now_ns: Callable[[], int],
    line: SerialEnd | None,
    expose: ExposeWide | None = None,
) -> OrbitDevices:
    """Build the devices of an orbit; `line` is the receiver's end of its serial line.

    `expose` replaces the renderer of the wide cameras. Raises ConfigError in a world without an orbit.
    """
    receiver, strings, errors = (np.random.default_rng([section.seed, _STREAM, n]) for n in range(3))
    truth = section.orbit_devices
    gps = None
    if config.gps is not None and line is not None:
        settings = GpsErrors(walk=truth.gps_walk, noise=truth.gps_noise, start=truth.gps_start)
        gps = EmulatedGps(orbiting(world, "gps"), line, receiver, settings, now_ns())
    measured = None
    if config.solar_strings is not None:
        where = orbiting(world, "solar_strings")
        measured = _strings(config.solar_strings, truth, where, now_ns, strings, errors)
    wide = tuple(
        _wide(camera, (section.seed, _STREAM, index), orbiting(world, "wide_cameras"), now_ns, expose)
        for index, camera in enumerate(config.wide_cameras)
    )
    return OrbitDevices(gps, measured, wide)


def _strings(
    section: SolarStringsSection,
    truth: OrbitDeviceTruth,
    world: OrbitingWorld,
    now_ns: Callable[[], int],
    generator: np.random.Generator,
    errors: np.random.Generator,
) -> EmulatedSolarCells:
    model = SolarCellsModel(
        normals=np.array([string.normal for string in section.strings]),
        peaks=np.array([string.peak for string in section.strings]),
        gain_errors=truth.string_gain * errors.standard_normal(len(section.strings)),
        noise=truth.string_noise,
        albedo=truth.albedo,
    )
    wirings = [StringWiring(s.address, s.channel, s.volt_per_ampere) for s in section.strings]
    return EmulatedSolarCells(world, model, wirings, now_ns, generator)


def wide_model(camera: WideCamera, seed: int = 0) -> EarthCameraModel:
    """Return optics and detector of a wide camera."""
    if camera.lens is None:
        lens = Lens.of(
            Pinhole.from_field_of_view(camera.columns, camera.rows, math.radians(camera.field_of_view_deg))
        )
    else:
        known = camera.lens
        lens = Lens(camera.columns, camera.rows, known.focal_length, known.centre, known.k1, known.k2)
    return EarthCameraModel(
        lens=lens,
        rows=camera.rows,
        columns=camera.columns,
        bits=camera.bits,
        response=camera.response,
        decades=camera.decades,
        pedestal=camera.pedestal,
        seed=seed,
    )


def _wide(
    camera: WideCamera,
    seed: tuple[int, ...],
    world: OrbitingWorld,
    now_ns: Callable[[], int],
    expose: ExposeWide | None,
) -> EmulatedCamera:
    model, make = wide_model(camera, seed[-1]), expose or inline_wide

    def exposed(sequence: int, _: FloatArray, attitudes: FloatArray, __: object) -> Future[Image]:
        date = _UNIX_EPOCH + world.utc_ns() * 1e-9 / 86_400.0
        scene = EarthScene(
            position=np.array(world.surroundings().position),
            attitude=attitudes[len(attitudes) // 2],
            sun=sun_position(date),
            rotation=_EARTH_TURN * world.utc_ns() * 1e-9 % (2.0 * math.pi),
        )
        return make(model, scene, (*seed, sequence))

    shown: Expose = exposed
    return EmulatedCamera(world.motion, shown, now_ns, READOUT_NS, np.array(camera.mounting))


def render_wide(model: EarthCameraModel, scene: EarthScene, seed: tuple[int, ...]) -> Image:
    """Return the frame of a scene."""
    return render(model, scene, np.random.default_rng(seed))


def inline_wide(model: EarthCameraModel, scene: EarthScene, seed: tuple[int, ...]) -> Future[Image]:
    """Render at once, for lock-step."""
    future: Future[Image] = Future()
    future.set_result(render_wide(model, scene, seed))
    return future
