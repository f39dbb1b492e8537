"""Tests of the devices in orbit, which the flight drivers read in lock-step."""

from __future__ import annotations

import itertools
import math
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from flight.app.devices import opened as opened_device
from flight.schema import reader
from flight.schema.document import ConfigError
from ground.telemetry import scan
from hal.interfaces.devices import Frame, GpsReading
from hal.interfaces.errors import NotResponding
from hal.interfaces.wires import SECOND_NS, Rig
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.orientation import celestial_to_terrestrial, geodetic
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.sun import SunSettings, find_sun
from sim_hal.assembly import assemble, wide_model
from sim_hal.clock import SimClock
from sim_hal.emulation import EmulatedWires
from sim_hal.emulators import power
from sim_hal.emulators.gps import GpsErrors
from sim_hal.emulators.power import SolarCellsModel
from sim_hal.emulators.serial_line import EmulatedSerialLine
from sim_hal.faults.schedule import parse, put
from sim_hal.rig import LockStep, build_lockstep, opened_lockstep, utc_ns
from sim_hal.settings import FaultEntry, SkySection
from sim_hal.star_camera.objects import aberrated, sunlit_ground_angle, view
from sim_hal.worlds.free_body import FreeBody
from sim_hal.worlds.world import OrbitEnvironment, OrbitingWorld
from tests.hal.gps.bench_line import bench
from tests.sim_hal.faults.benches import bench_of
from tests.support.compiled_forms import assert_forms_agree
from tests.support.flights import TEXT, demo_config, demo_world
from tests.support.orbit_devices import UTC, at_first, orbit_config, orbit_world


@pytest.fixture
def lock() -> LockStep:
    return build_lockstep(orbit_config(), orbit_world(), None, SimClock(utc_ns(UTC)))


def opened(lock: LockStep, stack: ExitStack) -> Rig:
    return lock.rig()


def shot(lock: LockStep, number: int = 0) -> Frame | None:
    """Return the frame of a horizon camera half a second after its trigger."""
    camera = lock.hardware.orbit.wide[number]
    camera.trigger(5_000_000)
    lock.clock.sleep_until_ns(lock.clock.now_ns() + SECOND_NS // 2)
    return camera.poll()


def fixes(lock: LockStep, rig: Rig, stack: ExitStack, seconds: int) -> list[GpsReading]:
    gps = opened_device("gps", orbit_config(), rig, stack)
    assert gps is not None
    found = []
    for _ in range(10 * seconds):
        lock.clock.sleep_until_ns(lock.clock.now_ns() + SECOND_NS // 10)
        found += gps.poll()
    return found


def test_the_receivers_time_is_the_simulations_and_its_place_the_worlds(lock: LockStep) -> None:
    with ExitStack() as stack:
        newest = fixes(lock, opened(lock, stack), stack, 5)[-1]
    assert newest.valid
    age = lock.clock.utc_ns() - newest.utc_ns
    assert 0 < age < 2 * SECOND_NS
    world = lock.hardware.world
    assert isinstance(world, FreeBody)
    assert np.linalg.norm(newest.position) == pytest.approx(
        np.linalg.norm(world.surroundings().position), abs=2e3
    )


def test_the_strings_are_read_over_the_coils_bus(lock: LockStep) -> None:
    with ExitStack() as stack:
        strings = opened_device("solar_strings", orbit_config(), opened(lock, stack), stack)
        assert strings is not None
        lock.clock.sleep_until_ns(2 * SECOND_NS)
        reading = strings.latest()
        assert reading is not None
        assert reading.currents.max() > 0.25  # one of the six faces is always within 55 deg of the Sun
        assert strings.error() == ""


def looking(boresight: FloatArray, camera: bool = False) -> LockStep:
    return build_lockstep(orbit_config(camera), orbit_world(boresight), None, SimClock(utc_ns(UTC)))


def test_a_wide_camera_sees_the_sun_where_it_is() -> None:
    around = at_first()
    aside = np.cross(around.sun, [0.0, 0.0, 1.0])
    frame = shot(looking(np.array(around.sun) + 0.2 * aside))
    assert frame is not None
    model = wide_model(orbit_config().wide_cameras[0])
    solution = find_sun(frame.pixels, model.lens, SunSettings())
    assert solution.sun is not None
    tilt = np.arccos(np.clip(solution.sun.direction[2], -1.0, 1.0))
    assert tilt == pytest.approx(np.arctan(0.2 * np.linalg.norm(aside)), abs=np.radians(0.5))


def test_a_wide_camera_sees_the_dark_sky_above_and_the_bright_earth_below() -> None:
    around = at_first()
    up = np.array(around.position) / np.linalg.norm(around.position)
    north = np.cross(up, np.cross([0.0, 0.0, 1.0], up))
    sky, ground = shot(looking(north + 0.8 * up)), shot(looking(-up))
    assert sky is not None
    assert ground is not None
    assert np.median(sky.pixels) < 20
    assert np.median(ground.pixels) > 40


def test_frames_repeat_with_the_seed_and_cost_little(lock: LockStep) -> None:
    other = build_lockstep(orbit_config(), orbit_world(), None, SimClock(utc_ns(UTC)))
    first, second = shot(lock, 1), shot(other, 1)
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.pixels, second.pixels)


def test_faults_reach_the_drivers(lock: LockStep) -> None:
    faults = ["gps: false (distance=50000) @ 3", "strings: off @ 1", "wide: off (camera=2) @ 1"]
    put([parse(fault) for fault in faults], bench_of(lock), 0)
    with ExitStack() as stack:
        rig = opened(lock, stack)
        strings = opened_device("solar_strings", orbit_config(), rig, stack)
        assert strings is not None
        found = fixes(lock, rig, stack, 6)
        # The point below the satellite moves by 7.1 km in a second.
        jumps = np.diff([fix.position for fix in found if fix.valid], axis=0)
        assert sorted(np.linalg.norm(jumps, axis=1))[-1] > 4e4
        assert "check its power" in strings.error()
    assert shot(lock, 0) is not None
    with pytest.raises(NotResponding):
        lock.hardware.orbit.wide[1].trigger(5_000_000)


def test_a_world_without_an_orbit_has_no_such_devices() -> None:
    with pytest.raises(ConfigError, match=r"gps: needs a world with an orbit"):
        build_lockstep(orbit_config(), demo_world(), None, SimClock())


DEVICES = """
gps: {period: 2.0}
solar_strings:
  strings:
    - {normal: [1, 0, 0], channel: 0}
    - {normal: [-1, 0, 0], channel: 1}
    - {normal: [0, 1, 0], channel: 2}
    - {normal: [0, 0, 1], channel: 3}
wide_cameras:
  - {mounting: [0, 0, 0, 1], field_of_view_deg: 70}
"""


def test_a_configuration_describes_the_devices() -> None:
    config = reader.parse(TEXT + DEVICES)
    assert config.gps is not None
    assert config.solar_strings is not None
    assert (config.gps.period, len(config.solar_strings.strings), len(config.wide_cameras)) == (2.0, 4, 1)
    page = Path("docs/fly/simulation.md").read_text(encoding="utf-8")
    shown = page.split("sim_hal/test_orbit_devices.py -->\n```yaml\n")[1].split("```")[0]
    documented = reader.parse(TEXT + shown)
    assert documented.gps is not None
    assert documented.gps.device == "/dev/ttyS2"
    assert reader.parse(TEXT + "gps: none\n").gps is None


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("channel: 1}", "channel: 0}", r"strings\[1\].channel.*another string"),
        (
            "[0, 1, 0], channel: 2",
            "[0, 1, 0], channel: 2, address: 0x40",
            r"strings\[2\].address` is 0x40, which `coils.address` also uses",
        ),
        ("[0, 0, 1]", "[0, 1, 1]", r"strings\[3\].normal.*unit vector"),
        ("[0, 0, 0, 1]", "[0, 0, 0, 2]", r"wide_cameras\[0\].mounting.*length"),
        ("period: 2.0", "period: 0.0", r"gps.period"),
    ],
)
def test_impossible_devices_are_refused(old: str, new: str, complaint: str) -> None:
    assert old in DEVICES
    with pytest.raises(ConfigError, match=complaint):
        reader.parse(TEXT + DEVICES.replace(old, new))


def star_frame(boresight: FloatArray) -> Frame:
    """Return the frame of a star camera that looks along a direction (ICRS)."""
    lock = looking(boresight, camera=True)
    frames = lock.hardware.camera
    assert frames is not None
    frames.trigger(200_000_000)
    lock.clock.sleep_until_ns(SECOND_NS)
    frame = frames.poll()
    assert frame is not None
    return frame


def test_sun_and_lit_earth_blind_the_star_camera_and_the_free_sky_shows_stars() -> None:
    around = at_first()
    up = np.array(around.position) / np.linalg.norm(around.position)
    assert star_frame(np.array(around.sun)).pixels.min() == 65_535
    assert star_frame(-up).pixels.min() == 65_535
    stars = star_frame(np.cross(up, np.cross([0.0, 0.0, 1.0], up)) + 0.8 * up).pixels
    assert stars.max() > 2 * np.median(stars)
    assert np.median(stars) < 1000


def test_the_dark_earth_hides_the_stars_behind_it() -> None:
    pinhole = Pinhole.from_field_of_view(200, 200, np.radians(20.0))
    around = at_first()._replace(position=(-7e6, 0.0, 0.0), sun=(1.0, 0.0, 0.0), sunlit=0.0)
    disc = np.arcsin(EARTH_RADIUS / 7e6)
    limb = np.array([np.cos(disc), np.sin(disc), 0.0])
    to_camera = np.stack([np.array([-limb[1], limb[0], 0.0]), [0.0, 0.0, -1.0], limb])
    blinded, hidden = view(pinhole, to_camera, around, SkySection())
    assert not blinded
    assert hidden is not None
    assert np.mean(hidden) == pytest.approx(0.5, abs=0.05)
    assert hidden[100, 0]
    assert not hidden[100, 199]


def edge_on(limb_deg: float, sun: FloatArray) -> tuple[FloatArray, OrbitEnvironment]:
    """Return the rotation (3, 3) from ICRS to a camera's axes, and the environment of its satellite.

    The satellite is on the x axis of ICRS. The boresight is `limb_deg` deg outside the Earth's limb.
    """
    around = at_first()._replace(position=(7e6, 0.0, 0.0), sun=tuple(sun.tolist()), sunlit=1.0)
    angle = math.pi - math.asin(EARTH_RADIUS / 7e6) - math.radians(limb_deg)
    boresight = np.array([math.cos(angle), math.sin(angle), 0.0])
    return np.stack([[-boresight[1], boresight[0], 0.0], [0.0, 0.0, -1.0], boresight]), around


PINHOLE = Pinhole.from_field_of_view(200, 200, math.radians(20.0))
ABOVE = np.array([1.0, 0.0, 0.0])
SIDES = np.array([0.0, -1.0, 0.0])
"""Sun direction over the side of the Earth that the camera does not see."""


@pytest.mark.parametrize(
    ("limb_deg", "excluded_deg", "blinded"), [(19, 20, True), (21, 20, False), (13, 5, True)]
)
def test_the_baffle_and_the_field_exclude_the_limb_of_the_sunlit_earth(
    limb_deg: float, excluded_deg: float, blinded: bool
) -> None:
    """The sunlit Earth spoils a frame if its limb is within the baffle's cone or the field of view.

    The corner of the field is 14 deg from the boresight.
    """
    sky = SkySection(sun_exclusion_deg=30.0, earth_exclusion_deg=excluded_deg)
    assert view(PINHOLE, *edge_on(limb_deg, ABOVE), sky)[0] == blinded
    assert not view(PINHOLE, *edge_on(limb_deg, SIDES), sky)[0], "the near side of the Earth is dark"


@pytest.mark.parametrize(
    ("sun_deg", "excluded_deg", "blinded"), [(29, 30, True), (31, 30, False), (13, 5, True)]
)
def test_the_baffle_and_the_field_exclude_the_sun(sun_deg: float, excluded_deg: float, blinded: bool) -> None:
    to_camera, around = edge_on(90.0, ABOVE)
    sun = math.cos(math.radians(sun_deg)) * to_camera[2] + math.sin(math.radians(sun_deg)) * to_camera[1]
    sky = SkySection(sun_exclusion_deg=excluded_deg, earth_exclusion_deg=0.0)
    assert view(PINHOLE, to_camera, around._replace(sun=tuple(sun.tolist())), sky)[0] == blinded
    shaded = around._replace(sun=tuple(sun.tolist()), sunlit=0.0)
    assert not view(PINHOLE, to_camera, shaded, sky)[0], "the Sun is behind the Earth"


def test_the_sunlit_ground_is_found_at_the_limb_and_at_the_terminator() -> None:
    to_camera, around = edge_on(25.0, ABOVE)
    position = np.array(around.position)
    assert sunlit_ground_angle(position, ABOVE, to_camera[2]) == pytest.approx(math.radians(25.0), abs=1e-9)
    assert sunlit_ground_angle(position, -ABOVE, to_camera[2]) == math.pi
    # If the Sun is at the horizon of the satellite, the sunlit ground begins 6 deg (0.1 rad) from the point
    # below the satellite.
    ground = EARTH_RADIUS * np.array([math.cos(0.1), math.sin(0.1), 0.0])
    away = ground - position
    expected = math.acos(away @ to_camera[2] / float(np.linalg.norm(away)))
    found = sunlit_ground_angle(position, SIDES, to_camera[2])
    assert found == pytest.approx(expected, abs=math.radians(3.0))
    assert sunlit_ground_angle(position, ABOVE, -ABOVE) == pytest.approx(0.0, abs=1e-6)


def test_aberration_moves_the_stars_towards_the_velocity() -> None:
    """Aberration displaces the stars towards the velocity.

    The displacement is 20.5 arcsec at 29.8 km/s normal to the line of sight, and zero along the line of
    sight.
    """
    attitude = quaternion.IDENTITY[None, :]
    moved = aberrated(attitude, np.array([29_800.0, 0.0, 0.0]))
    star = quaternion.attitude_matrix(moved)[0] @ [0.0, 0.0, 1.0]
    assert np.degrees(star[0]) * 3600.0 == pytest.approx(20.5, abs=0.1)
    assert star[1] == 0.0
    along = aberrated(attitude, np.array([0.0, 0.0, 29_800.0]))
    np.testing.assert_array_equal(along, attitude)


def test_the_truth_of_the_orbit_is_logged_once_a_second(tmp_path: Path) -> None:
    with opened_lockstep(orbit_config(), orbit_world(), tmp_path) as lock:
        lock.release(0)
        lock.clock.sleep_until_ns(5 * SECOND_NS + 1)
    packets = scan(b"".join(path.read_bytes() for path in sorted(tmp_path.glob("truth-*")))).packets
    logged = packets["orbit_truth"]
    assert logged["time_ns"].tolist() == [second * SECOND_NS for second in range(6)]
    first, around = logged[0], at_first()
    np.testing.assert_array_equal(first["position"], around.position)
    np.testing.assert_array_equal(first["sun"], around.sun)
    assert first["sunlit"] == 1.0
    assert abs(first["residual_dipole"] @ first["dipole_torque"]) < 1e-20
    sizes = [np.linalg.norm(first[f"{cause}_torque"]) for cause in ("dipole", "gravity", "drag", "sunlight")]
    assert all(0.0 < size < 1e-7 for size in sizes)
    assert len(packets["truth"]) == 201


def test_a_slow_start_shifts_no_device_in_time() -> None:
    """A slow start does not shift the time of any device.

    In real time the clock advances while the devices are built. In this test the clock advances by half a
    second per reading.
    """
    clock = itertools.count(10 * SECOND_NS, SECOND_NS // 2)
    wires = EmulatedWires(clock.__next__, 1, orbit_config().coils.bus)
    hardware = assemble(orbit_config(), orbit_world(), clock.__next__, wires)
    world, gps = hardware.world, hardware.orbit.gps
    assert isinstance(world, OrbitingWorld)
    assert gps is not None
    now_ns = 20 * SECOND_NS
    world.advance_to(now_ns)
    gps.needs_model = False  # no driver configures the receiver in this test
    truth, seen = world.orbit_truth(), gps._measure(now_ns)
    longitude, latitude, _ = geodetic(celestial_to_terrestrial(truth.utc) @ truth.position)
    assert seen.longitude * 1e-7 == pytest.approx(math.degrees(longitude), abs=1e-3)
    assert seen.latitude * 1e-7 == pytest.approx(math.degrees(latitude), abs=1e-3), "0.5 s are 0.034 deg"


def test_an_emulated_port_that_its_driver_has_closed_is_opened_again() -> None:
    clock = itertools.count(0, SECOND_NS)
    wires = EmulatedWires(clock.__next__, 1, orbit_config().coils.bus)
    assemble(orbit_config(), orbit_world(), clock.__next__, wires)
    gps = orbit_config().gps
    assert gps is not None
    port, line = wires.serial(gps.device, gps.baud_rate), wires.lines[gps.device]
    assert isinstance(line, EmulatedSerialLine)
    port.close()
    with pytest.raises(NotResponding, match="closed"):
        port.receive()
    line.device.write(b"lost", next(clock))
    again = wires.serial(gps.device, gps.baud_rate)
    line.device.write(b"again", next(clock))
    assert b"".join(data for _, data in again.receive()) == b"again"


@pytest.mark.parametrize("in_lamplight", [False, True])
def test_the_noise_of_the_solar_strings_has_the_configured_standard_deviation(in_lamplight: bool) -> None:
    model = SolarCellsModel(np.eye(3), np.full(3, 0.5), np.zeros(3), noise=3e-3)
    rng, sun, lit = np.random.default_rng(7), np.array([1.0, 0.0, 0.0]), []
    for _ in range(150):
        if in_lamplight:
            currents = model.in_lamplight(sun, rng)
        else:
            currents = model.currents(7e6 * sun, ASTRONOMICAL_UNIT * sun, np.eye(3), rng)
        lit.append(currents[0])
    assert np.std(lit) == pytest.approx(3e-3, rel=0.25)


@pytest.mark.parametrize("altitude", [350e3, 550e3, 1200e3])
def test_the_light_of_the_ground_changes_by_less_than_a_part_in_5000_over_100_m(altitude: float) -> None:
    """The simulation rounds the distance to 100 m, so the rounding error is at most half of this change."""
    model = SolarCellsModel(np.concatenate([np.eye(3), -np.eye(3)]), np.ones(6), np.zeros(6), noise=0.0)
    rng = np.random.default_rng(3)
    for _ in range(20):
        up, sun = (quaternion.normalise(rng.standard_normal(3)) for _ in range(2))
        low, high = (
            model.currents_in_light((EARTH_RADIUS + altitude + step) * up, sun, 0.0, np.eye(3), rng)
            for step in (0.0, 100.0)
        )
        np.testing.assert_allclose(low, high, rtol=2e-4, atol=1e-5)


def test_a_scheduled_fault_unplugs_the_serial_port_so_that_the_driver_is_refused() -> None:
    section = reader.replace(demo_world(), faults=(FaultEntry(fault="imu: unplugged @ 0.1 for 0.2"),))
    lock = build_lockstep(demo_config(10.0, camera=False), section, None, SimClock())
    lock.release(0)
    lock.line.host.receive()
    lock.clock.sleep_until_ns(SECOND_NS // 5)
    with pytest.raises(NotResponding, match="unplugged"):
        lock.line.host.receive()
    lock.clock.sleep_until_ns(SECOND_NS)
    assert lock.line.host.receive()


def test_without_satellites_the_solution_is_zero_and_its_accuracy_unknown() -> None:
    gps = bench()
    gps.fly(2.0)
    found = gps.gps._measure(3 * SECOND_NS)
    assert (found.fix, found.satellites, found.horizontal, found.speed_accuracy) == (3, 11, 1, 1)
    gps.gps.blind = True
    empty = gps.gps._measure(4 * SECOND_NS)
    assert (empty.longitude, empty.latitude, empty.height, empty.velocity) == (0, 0, 0, (0, 0, 0))
    assert (empty.fix, empty.flags, empty.satellites) == (0, 0, 0)
    assert (empty.horizontal, empty.vertical, empty.speed_accuracy) == (2**32 - 1, 2**32 - 1, 20_000)
    assert empty.date[-1] == found.date[-1] + 1, "the clock goes on"


@pytest.mark.parametrize("walk_time", [1.0, 4.0])
def test_the_walk_of_the_position_keeps_its_size_and_is_correlated_over_its_time(walk_time: float) -> None:
    errors = GpsErrors(walk=3.0, walk_time=walk_time, noise=0.0, velocity_noise=0.0)
    wandering, exact = bench(errors), bench()
    wandering.gps.needs_model = exact.gps.needs_model = False  # no driver configures the receivers
    off = []
    for second in range(1, 501):
        wrong, right = (one.gps._measure(second * SECOND_NS) for one in (wandering, exact))
        off.append((wrong.height - right.height) * 1e-3)  # error of the height, m
    walk = np.array(off)
    correlation = float(walk[1:] @ walk[:-1] / (walk @ walk))
    assert correlation == pytest.approx(math.exp(-1.0 / walk_time), abs=0.12)
    assert float(np.sqrt(np.mean(walk**2))) == pytest.approx(3.0, rel=0.25)


@pytest.mark.parametrize("grazing", [0.0, 0.1])
def test_both_forms_of_the_irradiance_of_solar_strings_agree(grazing: float) -> None:
    generator = np.random.default_rng(5)
    rays, ground, _ = power._ground_in_view(68_780)
    normals, local = (
        quaternion.attitude_matrix(quaternion.normalise(generator.standard_normal(4))) for _ in range(2)
    )
    for sun in (local[2], -local[2], local[0]):
        arguments = np.concatenate([normals, -normals]), local, sun, 0.9, rays, ground, 2e-4, grazing
        assert_forms_agree(power._irradiance, *arguments)
