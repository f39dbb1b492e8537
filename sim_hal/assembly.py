"""Assembly of the simulated hardware of a configuration: a simulated world with emulated devices.

The emulated buses and lines implement the same Protocols as those on Linux, so simulated flights exercise the
flight drivers. The body is held still at its initial attitude until its release. The modules of cameras and
orbit devices are imported only in the functions that use them, because the import takes half a second and a
testbed flight needs neither cameras nor orbit devices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np

from flight.schema.bodies import OrbitConfig
from flight.schema.devices import Camera, CameraLens, UnitCalibration, WideCamera, driver_of, lens_model
from flight.schema.devices import camera_model as lens_of
from flight.schema.document import ConfigError
from flight.schema.sections import Config
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.catalogue import load
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.vision.camera.lens import Lens
from sim_hal.clock import FaultTimeline, TimedSimulation
from sim_hal.description_errors import NO_ERRORS, description_errors
from sim_hal.emulation import NO_EMULATOR, ORBIT_STREAM, EmulatedWires, Emulation, emulated
from sim_hal.emulators.camera import EmulatedCamera, Expose, no_objects
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from sim_hal.settings import Simulation, SkySection
from sim_hal.worlds.world import (
    BodyMotion,
    OrbitingWorld,
    TruthRecorder,
    World,
    WorldInputs,
    make_world,
    orbiting,
    utc_date,
)

if TYPE_CHECKING:
    from sim_hal.earth_camera import EarthCameraModel, EarthScene
    from sim_hal.emulators.power import EmulatedPower
    from sim_hal.star_camera import SourceTrack, StarCameraModel
    from sim_hal.star_camera.objects import SkyObjects

READOUT_NS = 50_000_000
_FAULT_STREAM = 0xFA017
_EARTH_RATE = 2.0 * math.pi * 1.002_737_909_35 / 86_400.0

ExposeWide = Callable[["EarthCameraModel", "EarthScene", tuple[int, ...]], "Future[Image]"]
"""Function that renders a scene of the Earth with noise drawn from a seed."""


@dataclass(frozen=True, slots=True)
class OrbitDevices:
    """Emulated devices that need an orbit. The attribute `wide` contains the emulated horizon cameras."""

    gps: Any = None
    cells: Any = None
    wide: tuple[EmulatedCamera, ...] = ()


@dataclass(frozen=True, slots=True)
class Hardware:
    """All simulated devices. Drivers use only wires and cameras; simulated faults and tests use all devices.

    Emulated devices for drivers of other packages may have any type; simulated faults act only on devices for
    the drivers of this package. `utc_offset_ns` is the simulated UTC minus the simulation time, or None in a
    world without an orbit.
    """

    simulation: TimedSimulation
    world: World
    wires: EmulatedWires
    unit: Any
    circuit: Any
    monitor: Any
    camera: EmulatedCamera | None
    truth: TruthRecorder | None
    faults: FaultTimeline
    orbit: OrbitDevices
    objects: SkyObjects | None
    utc_offset_ns: int | None
    power: EmulatedPower | None = None

    @property
    def bus(self) -> EmulatedI2cBus:
        """The I2C bus of the coils."""
        return self.wires.i2c()

    @property
    def pwm(self) -> Any:
        """The PWM chip that drives the coils."""
        return self.circuit.chip

    def release(self, epoch_ns: int) -> None:
        """Release the body at mission time zero, which is `epoch_ns`."""
        self.world.release_at(epoch_ns)
        if self.objects is not None:
            self.objects.begin(epoch_ns)
        if self.truth is not None:
            self.truth.begin(epoch_ns)


def assemble(
    config: Config,
    section: Simulation,
    now_ns: Callable[[], int],
    wires: EmulatedWires,
    truth: TruthRecorder | None = None,
    expose: Expose | None = None,
    expose_wide: ExposeWide | None = None,
) -> Hardware:
    """Build the hardware of `config` in the world of its simulation `section`, and connect it to `wires`.

    The function `now_ns` returns the simulation time. The functions `expose` and `expose_wide`, if given,
    replace the camera renderers; in real time, both functions render in another process. Raises ConfigError
    if the configuration of the simulated world is invalid.
    """
    # In real time, the clock advances during assembly, so all devices get the same start time.
    start_ns = now_ns()
    unit_seed, circuit_seed = np.random.SeedSequence(section.seed).spawn(2)
    circuit, monitor = assemble_coils(config, section, np.random.default_rng(circuit_seed), now_ns, wires)
    world = make_world(WorldInputs(config, section, circuit.currents, start_ns))
    utc_offset_ns = world.utc_ns() - start_ns if isinstance(world, OrbitingWorld) else None
    receiver, currents = (np.random.default_rng([section.seed, ORBIT_STREAM, n]) for n in range(2))
    sense, generator = _sense(config, section, world, circuit), np.random.default_rng(unit_seed)
    times = now_ns, start_ns
    given = Emulation(
        "inertial_unit", wires, config, section, generator, *times, world, sense, circuit.mean_supply
    )
    unit = emulated(given)
    if (magnetometer := config.magnetometer) is not None:
        # The errors of the second magnetometer are drawn with another seed.
        own = msgspec.structs.replace(config, inertial_unit=magnetometer)
        other = msgspec.structs.replace(section, seed=section.seed + 1)
        generator = np.random.default_rng([section.seed, ORBIT_STREAM, 3])
        sense = _sense(own, other, world, circuit)
        emulated(replace(given, kind="magnetometer", generator=generator, sense=sense))
    objects = sky_objects(section, start_ns, world)
    camera = _star_camera(config, section, world, now_ns, objects, expose) if config.camera else None
    orbit = OrbitDevices(
        emulated(replace(given, kind="gps", generator=receiver)),
        emulated(replace(given, kind="solar_strings", generator=currents)),
        tuple(
            _horizon_camera(config, section, index, world, now_ns, expose_wide or inline_wide)
            for index in range(len(config.wide_cameras))
        ),
    )
    faults, power = FaultTimeline(), _power(given, camera)
    if truth is not None:
        truth.watch(world, _true_description(config, section, world))
        truth.power = power
    # Events at the same time are processed in the order of this list.
    devices = [unit, camera, orbit.gps, *orbit.wide, faults, power, truth, circuit, monitor, orbit.cells]
    timed = [device for device in devices if hasattr(device, "next_event_ns")]
    simulation, others = TimedSimulation(world.advance_to, timed), (faults, orbit, objects, utc_offset_ns)
    return Hardware(simulation, world, wires, unit, circuit, monitor, camera, truth, *others, power)


def _power(given: Emulation, camera: EmulatedCamera | None) -> EmulatedPower | None:
    """Return the power system with its monitors. Raises ConfigError if panels have no orbit."""
    section, truth = given.config.power, given.section.power
    if section is None:
        return None
    from sim_hal.emulators.power import EmulatedPower  # noqa: PLC0415 - only with a power system

    world = orbiting(given.world, "simulation.power.panels") if truth.panels else None
    power = EmulatedPower(section.battery, truth, world, given.supply, camera, given.start_ns)
    for (key, monitor), rail in zip(section.monitors().items(), power.rails, strict=False):
        driver = driver_of("power_monitor", monitor, f"{key}.driver")
        if driver.emulate is None:
            raise ConfigError(f"{key}.driver", f"is {monitor.driver!r}, {NO_EMULATOR}")
        rail.monitor = driver.emulate(replace(given, supply=rail.measure), monitor)
        rail.bus = given.wires.i2c(monitor.bus)
    return power


def _star_camera(
    config: Config,
    section: Simulation,
    world: World,
    now_ns: Callable[[], int],
    objects: SkyObjects | None,
    expose: Expose | None,
) -> EmulatedCamera:
    assert config.camera is not None
    make = expose or StarRenderer(config.camera, section.sky, section.seed).expose
    if isinstance(world, OrbitingWorld) and not getattr(world, "held", False):
        from sim_hal.star_camera.objects import from_orbit  # noqa: PLC0415 - see above

        make = from_orbit(make, world, config.camera, section.sky)
    misaligned = from_rotation_vector(description_errors(config, section).camera)
    mounting = multiply(np.array(config.camera.mounting), misaligned)
    return emulated_camera(config.camera, section.sky, world.motion, make, now_ns, objects, mounting=mounting)


def _true_description(config: Config, section: Simulation, world: World) -> dict[str, FloatArray] | None:
    """Return the fields of the packet `true_description`, or None if the world has no satellite."""
    craft = getattr(world, "craft", None)
    if craft is None or not isinstance(config, OrbitConfig):
        return None
    errors = description_errors(config, section)
    to_principal = attitude_matrix(craft.to_principal)
    inertia = to_principal.T @ np.diag(craft.inertia) @ to_principal
    return {
        "inertia": inertia[(0, 1, 2, 1, 2, 0), (0, 1, 2, 2, 0, 1)],
        "coils": config.coils.map().per_dipole(craft.coil_dipole),
        "gyro": errors.gyro,
        "field": errors.field,
        "camera": errors.camera,
    }


def assemble_coils(
    config: Config,
    section: Simulation,
    generator: np.random.Generator,
    now_ns: Callable[[], int],
    wires: EmulatedWires,
) -> tuple[Any, Any]:
    """Build the coil circuit and the current monitor, which is None if not configured.

    The emulator of a coil driver of another package returns a circuit with at least the methods `currents`
    and `mean_supply`.
    """
    truth = section.truth
    if truth.resistance is not None and len(truth.resistance) != len(config.coils.slots):
        given, coils = len(truth.resistance), len(config.coils.slots)
        problem = f"has {given} values: give one value for each of the {coils} coils"
        raise ConfigError("simulation.truth.resistance", problem)

    def unknown(*_: int) -> Any:
        raise AssertionError("coils are built before the world")

    given_coils = Emulation(
        "coils", wires, config, section, generator, now_ns, now_ns(), cast(World, None), unknown, unknown
    )
    circuit: Any = emulated(given_coils)
    return circuit, emulated(replace(given_coils, kind="power_monitor", supply=circuit.mean_supply))


def _coil_field(config: Config, section: Simulation) -> FloatArray:
    """Return the matrix (3, n), T/A, from the coil currents to their field at the magnetometer."""
    count = len(config.coils.slots)
    rows = section.coil_field or ((0.0,) * count,) * 3
    for row in rows:
        if len(row) not in {len(config.coils.windings), count}:
            problem = f"has {len(row)} values in a row: give one value for each of the {count} coils"
            raise ConfigError("simulation.coil_field", problem)
    return np.array([(*row, 0.0, 0.0)[:count] for row in rows])


def _sense(config: Config, section: Simulation, world: World, circuit: Any) -> Callable[[int], BodyMotion]:
    """Return a function from a time (ns) to the motion that the inertial unit senses.

    The magnetic field includes the bias of the magnetometer and the field of the coils.
    """
    errors, known = description_errors(config, section), config.inertial_unit.calibration
    gyro_matrix, field_matrix = np.array(known.gyro_matrix), np.array(known.field_matrix)
    coil_field, bias = _coil_field(config, section), np.array(section.imu.field_bias) + errors.field_bias
    if not (coil_field.any() or bias.any() or errors is not NO_ERRORS or known != UnitCalibration()):
        return world.motion

    offset = field_matrix @ bias + np.array(known.field_bias)
    gyro_matrix, field_matrix = gyro_matrix @ errors.gyro, field_matrix @ errors.field

    def sense(time_ns: int) -> BodyMotion:
        # The unit averages the field over one control period, so the coils' mean currents are used.
        motion = world.motion(time_ns)
        # The method `dot` takes half the time of the operator `@`.
        total: FloatArray = coil_field.dot(circuit.currents())
        total += motion.field_body
        field: FloatArray = field_matrix.dot(total)
        field += offset
        rate, force = gyro_matrix.dot(motion.rate), motion.specific_force_body
        return BodyMotion(motion.time_ns, motion.quaternion, rate, field, force)

    return sense


def sky_objects(section: Simulation, now_ns: int, world: World) -> SkyObjects | None:
    """Return the moving objects of a simulated sky, or None if none are configured.

    Raises ConfigError for an invalid object.
    """
    if not section.objects:
        return None
    from sim_hal.star_camera.objects import SkyObjects  # noqa: PLC0415 - see above

    return SkyObjects(section.objects, section.utc, now_ns, world)


def emulated_camera(
    camera: Camera,
    sky: SkySection,
    motion: Callable[[int], BodyMotion],
    expose: Expose,
    now_ns: Callable[[], int],
    objects: SkyObjects | None,
    *,
    mounting: FloatArray | None = None,
) -> EmulatedCamera:
    """Return the star camera on a moving body, with the given `mounting` (4,) or the configured mounting."""
    mounting = np.array(camera.mounting) if mounting is None else mounting
    if sky.lens is not None:
        mounting = multiply(_between_axes(camera, sky.lens), mounting)
    readout_ns, scan_ns = round(sky.readout * 1e9), round(sky.line_time * camera.rows * 1e9)
    tracks = no_objects if objects is None else objects.tracks
    return EmulatedCamera(motion, expose, now_ns, readout_ns, mounting, scan_ns, tracks)


def _between_axes(camera: Camera, true: CameraLens) -> FloatArray:
    """Return the rotation (4,) from the camera axes of the configuration to the axes of the true lens.

    The configured mounting is assumed to be measured with the true lens. The configured boresight is
    therefore the direction from which the true lens images a star onto the configured image centre.
    """
    lens = lens_model(true, camera.columns, camera.rows)
    x, y, z = lens.unit_vectors(np.array([lens_of(camera).centre]))[0]
    sine = math.hypot(x, y)
    angle = math.atan2(sine, z)
    return from_rotation_vector(np.array([y, -x, 0.0]) * (angle / sine if sine > 0.0 else 1.0))


def fault_generator(seed: int) -> np.random.Generator:
    """Return the random generator for device faults, independent of other generators with the same seed."""
    return np.random.default_rng([seed, _FAULT_STREAM])


def camera_model(camera: Camera, sky: SkySection) -> StarCameraModel:
    """Return the optics and detector of an emulated star camera."""
    from sim_hal.star_camera import StarCameraModel  # noqa: PLC0415 - see above

    lens = camera.lens if sky.lens is None else sky.lens
    return StarCameraModel(
        lens=None if lens is None else lens_model(lens, camera.columns, camera.rows),
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
    """Renderer of a star camera's frames; the noise of a frame depends only on seed and frame number."""

    def __init__(self, camera: Camera, sky: SkySection, seed: int) -> None:
        self._model = camera_model(camera, sky)
        self._directions, self._magnitudes = _stars(sky.magnitude_limit, sky.year)
        self._seed = seed

    def render(
        self, sequence: int, times: FloatArray, attitudes: FloatArray, tracks: Sequence[SourceTrack] = ()
    ) -> Image:
        """Return frame `sequence`, exposed while the camera has the `attitudes` (k, 4) at `times` (k,), s."""
        from sim_hal.star_camera import render  # noqa: PLC0415 - see above

        generator = np.random.default_rng([self._seed, sequence])
        return render(self._model, self._directions, self._magnitudes, times, attitudes, generator, tracks)

    def expose(
        self, sequence: int, times: FloatArray, attitudes: FloatArray, tracks: Sequence[SourceTrack]
    ) -> Future[Image]:
        """Render a frame synchronously, for lock-step."""
        return _finished(self.render(sequence, times, attitudes, tracks))


@lru_cache(maxsize=2)
def _stars(magnitude_limit: float, year: float) -> tuple[FloatArray, FloatArray]:
    """Return ICRS directions (n, 3) and Johnson V magnitudes (n,) of the stars up to a limit, read-only."""
    catalogue = load().brighter_than(magnitude_limit)
    directions = catalogue.directions_at(year)
    directions.setflags(write=False)
    return directions, catalogue.magnitude


def _finished(image: Image) -> Future[Image]:
    future: Future[Image] = Future()
    future.set_result(image)
    return future


def _horizon_camera(
    config: Config,
    section: Simulation,
    index: int,
    world: World,
    now_ns: Callable[[], int],
    expose: ExposeWide,
) -> EmulatedCamera:
    """Return a horizon camera. Raises ConfigError if the world has no orbit."""
    from sim_hal.earth_camera import EarthScene  # noqa: PLC0415 - see above
    from sim_hal.worlds.orbit import sun_position  # noqa: PLC0415 - see above

    camera, seed = config.wide_cameras[index], (section.seed, ORBIT_STREAM, index)
    model, orbit = wide_model(camera, index), orbiting(world, "wide_cameras")
    errors = description_errors(config, section).horizon
    misaligned = from_rotation_vector(errors[index] if len(errors) else np.zeros(3))

    def exposed(sequence: int, _: FloatArray, attitudes: FloatArray, __: object) -> Future[Image]:
        scene = EarthScene(
            position=np.array(orbit.surroundings().position),
            attitude=attitudes[len(attitudes) // 2],
            sun=sun_position(utc_date(orbit)),
            rotation=_EARTH_RATE * orbit.utc_ns() * 1e-9 % (2.0 * math.pi),
        )
        return expose(model, scene, (*seed, sequence))

    mounting = multiply(np.array(camera.mounting), misaligned)
    return EmulatedCamera(world.motion, exposed, now_ns, READOUT_NS, mounting)


def wide_model(camera: WideCamera, seed: int = 0) -> EarthCameraModel:
    """Return the model of a horizon camera's optics and detector."""
    from sim_hal.earth_camera import EarthCameraModel  # noqa: PLC0415 - see above

    return EarthCameraModel(
        lens=Lens.of(lens_of(camera)),
        rows=camera.rows,
        columns=camera.columns,
        bits=camera.bits,
        response=camera.response,
        decades=camera.decades,
        pedestal=camera.pedestal,
        seed=seed,
    )


def render_wide(model: EarthCameraModel, scene: EarthScene, seed: tuple[int, ...]) -> Image:
    """Return the horizon camera's frame of a scene."""
    from sim_hal.earth_camera import render  # noqa: PLC0415 - see above

    return render(model, scene, np.random.default_rng(seed))


def inline_wide(model: EarthCameraModel, scene: EarthScene, seed: tuple[int, ...]) -> Future[Image]:
    """Render a horizon camera's frame synchronously, for lock-step."""
    return _finished(render_wide(model, scene, seed))
