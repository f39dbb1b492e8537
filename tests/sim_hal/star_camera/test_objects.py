"""Tests of moving objects in the star camera's sky, and of Sun and Earth in the field of view."""

from __future__ import annotations

import math
import textwrap
from concurrent.futures import Future
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from flight.schema.devices import Camera
from flight.schema.document import ConfigError, config_path
from flight.schema.reader import load, simulation_section
from flight.schema.sections import Config
from hal.interfaces.errors import OutOfRange
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, DAY, SPEED_OF_LIGHT, earth_velocity, sunlit_share
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.lens import Pinhole
from sim_hal.clock import SimClock
from sim_hal.rig import posed_camera
from sim_hal.settings import (
    FreeBodySection,
    LineOfSight,
    ObjectState,
    OrbitSection,
    Simulation,
    SkyObject,
    SkySection,
    Tumble,
)
from sim_hal.star_camera import SourceTrack, StarCameraModel, expected_electrons
from sim_hal.star_camera.objects import (
    TRACK_ERROR,
    ResidentSpaceObject,
    SkyObjects,
    directions,
    from_orbit,
    hidden_by_earth,
    source_tracks,
)
from sim_hal.worlds.free_body import FreeBody
from sim_hal.worlds.orbit import KeplerianElements, propagate, sun_position
from sim_hal.worlds.world import OrbitingWorld
from tests.sim_hal.star_camera.scenes import centroid
from tests.support.exclusion import boresights, earth_in_field, in_field, sun_in_field
from tests.support.opportunities import (
    Scenario,
    constant_slew,
    exposure_attitudes,
    observable,
    opportunities,
    table_4_3,
    windows,
)

UTC = "2026-03-20T12:00:00Z"
EXPOSURE = 0.5


def _world() -> OrbitingWorld:
    return FreeBody(FreeBodySection(craft="cubesat_3u"), lambda: np.zeros(3), seed=1, utc=UTC)


def _line(direction: FloatArray, rate_deg: float, towards_deg: float = 30.0) -> LineOfSight:
    return LineOfSight(
        right_ascension_deg=float(np.degrees(np.arctan2(direction[1], direction[0]))),
        declination_deg=float(np.degrees(np.arcsin(direction[2]))),
        rate_deg=rate_deg,
        towards_deg=towards_deg,
    )


def _frame(config: Config, objects: tuple[SkyObject, ...]) -> tuple[Image, FloatArray]:
    """Return a frame of the configured camera at rest, and the attitude matrix of the camera."""
    text = config_path("step_demo").read_text()
    section = simulation_section(text, "step_demo", Simulation)
    assert section is not None
    changed = Simulation(release=section.release, sky=SkySection(magnitude_limit=0.0), objects=objects)
    clock = SimClock()
    posed = posed_camera(config, changed, clock, np.zeros(3))
    posed.frames.trigger(round(EXPOSURE * 1e9))
    clock.sleep_until_ns(2_000_000_000)
    frame = posed.frames.poll()
    assert frame is not None
    return frame.pixels.astype(float), attitude_matrix(posed.attitude(0))


def test_the_camera_shows_an_object_as_a_streak_of_its_rate_and_magnitude() -> None:
    config = load(config_path("step_demo"))
    camera = config.camera
    assert camera is not None
    empty, to_camera = _frame(config, ())
    entry = SkyObject(magnitude=2.0, line_of_sight=_line(to_camera[2], 0.6))
    seen, _ = _frame(config, (entry,))
    light = np.where(seen - empty > 60.0, seen - empty, 0.0)
    rows, columns = np.nonzero(light)
    pinhole = Pinhole.from_field_of_view(camera.columns, camera.rows, np.radians(camera.field_of_view_deg))
    length = np.radians(0.6) * EXPOSURE * pinhole.focal_length
    # The object starts at the boresight with constant brightness, so its centroid is half a streak length
    # away.
    weights, places = light[rows, columns], np.stack([columns, rows], axis=1).astype(float)
    middle = np.average(places, axis=0, weights=weights)
    assert np.hypot(*(middle - (camera.columns - 1) / 2)) == pytest.approx(length / 2, abs=0.5)
    # Along a uniform line of length L, the variance is L^2 / 12 plus the variance of the spot. Across the
    # line, only the spot contributes to the variance.
    across, along = np.linalg.eigvalsh(np.cov(places.T, aweights=weights))
    assert np.sqrt(12.0 * (along - across)) == pytest.approx(length, rel=0.05)


def test_an_object_in_orbit_is_shifted_by_its_motion_relative_to_the_camera_alone() -> None:
    """An object in orbit is displaced only by its motion relative to the camera.

    In the planetary aberration between two bodies near the Earth, the Earth's velocity cancels.
    """
    world = _world()
    around = world.surroundings()
    position, velocity = np.array(around.position), np.array(around.velocity)
    away = np.array(around.sun) * 30e3 + position / np.linalg.norm(position) * 100e3
    other = position + away
    sideways = np.cross(away, velocity)
    own = velocity + 900.0 * sideways / np.linalg.norm(sideways)
    state = ObjectState(position=tuple(other.tolist()), velocity=tuple(own.tolist()))
    objects = SkyObjects([SkyObject(magnitude=4.0, state=state)], UTC, 0, world)
    (track,) = objects.tracks(0, np.array([0.0, 0.25, 0.5]))
    assert track.magnitude == pytest.approx(4.0, abs=0.01)
    geometric = away / np.linalg.norm(away)
    date = 2_440_587.5 + world.utc_ns() * 1e-9 / 86_400.0
    shown = track.directions[0] + (earth_velocity(date) + velocity) / SPEED_OF_LIGHT
    expected = geometric + (velocity - own) / SPEED_OF_LIGHT
    assert np.linalg.norm(np.cross(shown, expected)) < 1e-7
    turned = np.arccos(np.clip(track.directions[0] @ track.directions[-1], -1.0, 1.0))
    assert turned / 0.5 == pytest.approx(900.0 / np.linalg.norm(away), rel=0.02)


def test_a_failed_rendering_of_a_frame_with_the_sun_is_reported() -> None:
    world = FreeBody(FreeBodySection(orbit=OrbitSection(local_time=12.0)), lambda: np.zeros(3))
    ahead = world.surroundings().sun[2] > 0.0
    attitudes = np.array([[0.0, 0.0, 0.0, 1.0] if ahead else [1.0, 0.0, 0.0, 0.0]] * 2)
    rendered: Future[Image] = Future()
    sky = SkySection(sun_exclusion_deg=90.0)
    expose = from_orbit(lambda *_: rendered, world, Camera(columns=64, rows=64), sky)
    frame = expose(1, np.array([0.0, 0.1]), attitudes, [])
    assert frame is not rendered, "the Sun is in view"
    rendered.set_exception(ValueError("too fast"))
    with pytest.raises(ValueError, match="too fast"):
        frame.result(timeout=0.0)


def test_a_tumbling_object_is_as_bright_as_its_mean_light_over_the_exposure() -> None:
    line = LineOfSight(right_ascension_deg=10.0, declination_deg=20.0, rate_deg=0.1)
    entries = [
        SkyObject(magnitude=3.0, line_of_sight=line, tumble=Tumble(period=400.0, amplitude=1.0)),
        SkyObject(magnitude=3.0, line_of_sight=line, tumble=Tumble(period=0.5, amplitude=1.0)),
    ]
    objects = SkyObjects(entries, UTC, 0, _world())
    objects.begin(5_000_000_000)
    slow, fast = objects.tracks(105_000_000_000, np.array([0.0, 0.5]))
    assert slow.magnitude == pytest.approx(4.0, abs=1e-4)
    # The mean of exp(x sin) over a rotation is the modified Bessel function I0(x), and I0(0.921) = 1.2236.
    assert fast.magnitude == pytest.approx(3.0 - 2.5 * np.log10(1.2236), abs=1e-3)
    # At 0.1 deg/s, the object has moved by 10 deg due north at the mission time 100 s.
    assert np.degrees(np.arcsin(slow.directions[0, 2])) == pytest.approx(30.0, abs=1e-9)


def test_an_object_without_place_or_an_orbit_on_the_testbed_is_refused() -> None:
    line, state = (
        LineOfSight(right_ascension_deg=0.0, declination_deg=0.0),
        ObjectState(position=(7e6, 0.0, 0.0), velocity=(0.0, 7.5e3, 0.0)),
    )
    for entry in (SkyObject(magnitude=3.0), SkyObject(magnitude=3.0, line_of_sight=line, state=state)):
        with pytest.raises(ConfigError, match=r"objects\[0\].*either"):
            SkyObjects([entry], UTC, 0, _world())
    kilometres = ObjectState(position=(7e3, 0.0, 0.0), velocity=(0.0, 7.5, 0.0))
    with pytest.raises(ConfigError, match=r"objects\[0\]\.state\.position: is 7000 m .*: give m"):
        SkyObjects([SkyObject(magnitude=3.0, state=kilometres)], UTC, 0, _world())
    with pytest.raises(ConfigError, match="orbit"):
        SkyObjects([SkyObject(magnitude=3.0, state=state)], UTC, 0, object())  # type: ignore[arg-type] # no world


def test_the_objects_of_the_documentation_are_read() -> None:
    page = Path("docs/fly/simulation.md").read_text()
    block = page.split("<!-- read by: tests/sim_hal/star_camera/test_objects.py -->\n```yaml\n")[1].split(
        "```"
    )[0]
    section = simulation_section("simulation:\n" + textwrap.indent(block, "  "), "page", Simulation)
    assert section is not None
    SkyObjects(section.objects, section.utc, 0, _world())
    assert [entry.magnitude for entry in section.objects] == [3.0, 4.5]


EPOCH = 2_461_041.5
"""2026 January 1.0."""
NO_STARS = np.zeros((0, 3))


@cache
def _table_4_3() -> Scenario:
    return table_4_3(EPOCH, half_angle=np.radians(10.0))


def _pair(ahead: float, duration: float = 6000.0) -> tuple[ResidentSpaceObject, ResidentSpaceObject]:
    """Return two objects on one circular orbit; the second object is `ahead` rad in front of the first."""
    elements = KeplerianElements(semi_major_axis=7000e3, inclination=1.0)
    leader = replace(elements, true_anomaly=ahead)
    first, second = (propagate(part, duration, j2=0.0) for part in (elements, leader))
    return ResidentSpaceObject(first, 4.0), ResidentSpaceObject(second, 4.0)


def test_a_track_points_from_the_camera_to_the_object() -> None:
    camera, leader = _pair(0.1)
    (track,) = source_tracks(camera.orbit, [leader], EPOCH, 3000.0, 3000.5)
    assert (track.times[0], track.times[-1]) == (3000.0, 3000.5)
    expected = leader.orbit.positions_at(track.times) - camera.orbit.positions_at(track.times)
    assert np.linalg.norm(expected[0]) == pytest.approx(2.0 * 7000e3 * np.sin(0.05), rel=1e-9)
    assert np.cross(track.directions, expected) == pytest.approx(0.0, abs=1.0)
    assert np.all(np.sum(track.directions * expected, axis=1) > 0.0)


def test_a_track_counts_time_from_where_the_attitude_does() -> None:
    camera, leader = _pair(0.1)
    (track,) = source_tracks(camera.orbit, [leader], EPOCH, 3000.0, 3000.5, zero=3000.0)
    assert (track.times[0], track.times[-1]) == (0.0, 0.5)


@pytest.mark.parametrize("height", [100.0, 5e3, 330e3])
def test_a_track_is_sampled_finely_enough_for_any_pass(height: float) -> None:
    """A track is sampled finely enough for any pass.

    If the orbits cross at a distance of `height` m, uniform motion between samples is correct to 1e-7 rad.
    """
    low = KeplerianElements(semi_major_axis=7000e3)
    high = KeplerianElements(semi_major_axis=7000e3 + height, inclination=1.5)
    camera, other = propagate(low, 10.0, j2=0.0), propagate(high, 10.0, j2=0.0)
    (track,) = source_tracks(camera, [ResidentSpaceObject(other, 4.0)], EPOCH, 0.0, 0.5)
    times = np.linspace(0.0, 0.5, 30_001)
    exact = directions(camera.positions_at(times), other.positions_at(times))
    off = np.linalg.norm(np.cross(track.directions_at(times), exact), axis=1)
    # At very short distances, the rounding errors of positions dominate.
    assert off.max() < 1.1 * TRACK_ERROR + 1e-8 * 7000.0 / height


def test_in_the_umbra_there_is_no_track_and_in_the_penumbra_a_fainter_one() -> None:
    camera, leader = _pair(0.1)
    times = np.linspace(0.0, 6000.0, 60_001)
    lit = sunlit_share(leader.orbit.positions_at(times), sun_position(EPOCH + times / DAY))
    dark = times[np.flatnonzero(lit == 0.0)]
    assert dark.size > 15_000
    half = float(times[np.argmin(np.abs(lit - 0.4))])
    assert source_tracks(camera.orbit, [leader], EPOCH, float(dark[5000]), float(dark[5000]) + 0.2) == []
    (faint,) = source_tracks(camera.orbit, [leader], EPOCH, half - 0.1, half + 0.1)
    assert faint.magnitude == pytest.approx(4.0 - 2.5 * np.log10(0.4), abs=0.1)
    bright = float(times[np.flatnonzero(lit == 1.0)[5000]])
    (whole,) = source_tracks(camera.orbit, [leader], EPOCH, bright, bright + 0.2)
    assert whole.magnitude == 4.0
    (cylinder,) = source_tracks(camera.orbit, [leader], EPOCH, bright, bright + 0.2, shadow="cylindrical")
    assert cylinder.magnitude == 4.0


def test_an_object_behind_the_earth_has_no_track() -> None:
    """An object behind the Earth has no track.

    Two objects on one orbit are visible to each other if they are up to 2 acos(R/a) = 48.7 deg apart.
    """
    clear = 2.0 * np.arccos(EARTH_RADIUS / 7000e3)
    epochs = (EPOCH, EPOCH + 182.0)
    for ahead, seen in ((clear - 0.01, True), (clear + 0.01, False)):
        camera, leader = _pair(ahead, 10.0)
        assert any(source_tracks(camera.orbit, [leader], epoch, 0.0, 0.5) for epoch in epochs) == seen


def test_several_objects_come_in_their_order_and_brightness() -> None:
    camera, leader = _pair(0.1)
    other = ResidentSpaceObject(leader.orbit, 6.5)
    times = np.linspace(0.0, 6000.0, 601)
    lit = sunlit_share(leader.orbit.positions_at(times), sun_position(EPOCH + times / DAY))
    start = float(times[np.flatnonzero(lit == 1.0)[0]])
    tracks = source_tracks(camera.orbit, [other, leader], EPOCH, start, start + 0.5)
    assert [track.magnitude for track in tracks] == [6.5, 4.0]


def test_a_track_with_impossible_arguments_is_refused() -> None:
    camera, leader = _pair(0.1)
    with pytest.raises(OutOfRange, match="end of the exposure"):
        source_tracks(camera.orbit, [leader], EPOCH, 1.0, 1.0)
    with pytest.raises(OutOfRange, match="time"):
        source_tracks(camera.orbit, [leader], EPOCH, 5999.9, 6000.1)
    with pytest.raises(OutOfRange, match="distance from the camera"):
        source_tracks(camera.orbit, [camera], EPOCH, 0.0, 0.5)


def test_a_track_of_lists_moves_uniformly_between_its_samples() -> None:
    track = SourceTrack([0, 2, 3], [[1, 0, 0], [0, 1, 0], [0, 0, 1]], 4.0)  # type: ignore[arg-type]
    assert {track.times.dtype, track.directions.dtype} == {np.dtype(np.float64)}
    root = math.sqrt(0.5)
    expected = [[1, 0, 0], [root, root, 0], [0, 1, 0], [0, root, root], [0, 0, 1]]
    assert track.directions_at(np.array([0.0, 1.0, 2.0, 2.5, 3.0])) == pytest.approx(np.array(expected))


@pytest.mark.parametrize(
    ("times", "directions", "magnitude", "complaint"),
    [
        ([0.0], [[1.0, 0, 0]], 4.0, "k of 2 or more"),
        ([0.0, 1.0], [[1.0, 0, 0]], 4.0, "k of 2 or more"),
        ([[0.0, 1.0]], [[1.0, 0, 0]], 4.0, "k of 2 or more"),
        ([0.0, 0.0], [[1.0, 0, 0], [0, 1.0, 0]], 4.0, "must be finite and increase"),
        ([0.0, math.inf], [[1.0, 0, 0], [0, 1.0, 0]], 4.0, "must be finite and increase"),
        ([0.0, 1.0], [[1.0, 0, 0], [0, 1.1, 0]], 4.0, "finite unit vectors"),
        ([0.0, 1.0], [[1.0, 0, 0], [0, math.nan, 0]], 4.0, "finite unit vectors"),
        ([0.0, 1.0], [[1.0, 0, 0], [0, 1.0, 0]], math.nan, "magnitude nan must be finite"),
    ],
)
def test_an_impossible_track_is_refused(
    times: list[float], directions: list[list[float]], magnitude: float, complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        SourceTrack(np.array(times), np.array(directions), magnitude)


def test_the_thesis_scenario_has_the_orbits_of_table_4_3() -> None:
    scenario = _table_4_3()
    camera, spacecraft = scenario.camera, scenario.objects[0].orbit
    start = np.array([0.0])
    assert camera.positions_at(start)[0] == pytest.approx([6748e3, 0.0, 0.0], abs=1e-6)
    # 150 deg from the node, along an orbit with an inclination of 89 deg.
    along, tilt = np.radians(150.0), np.radians(89.0)
    place = 7078e3 * np.array([np.cos(along), np.sin(along) * np.cos(tilt), np.sin(along) * np.sin(tilt)])
    assert spacecraft.positions_at(start)[0] == pytest.approx(place, abs=1.0)
    assert scenario.duration == pytest.approx(10.0 * 5516.7, abs=1.0)
    assert scenario.attitude(start)[0] == pytest.approx([0.0, 0.0, 0.0, 1.0])
    turned = scenario.attitude(np.array([10.0]))[0]
    assert quaternion.to_rotation_vector(turned) == pytest.approx([0.0, 0.5, 0.0])


def test_at_a_frame_a_second_the_thesis_scenario_has_about_as_many_opportunities() -> None:
    """With a frame a second, the scenario of the thesis has about as many passes as in the thesis.

    The thesis states 14 passes, without date and frame interval. With a frame a second, the number of passes
    in a year is 9 to 19.
    """
    counts = [
        len(opportunities(replace(_table_4_3(), epoch=EPOCH + day), cadence=1.0, exposure=0.5))
        for day in (0.0, 91.0, 137.0)
    ]
    assert counts[0] > 14 > counts[1]
    assert counts[2] == 14


def test_every_window_holds_within_and_fails_just_outside() -> None:
    scenario = _table_4_3()
    found = windows(scenario)
    assert len(found) >= 4
    for window in found:
        inside = np.linspace(window.start + 2e-3, window.end - 2e-3, 50)
        assert observable(scenario, window.index, inside).all()
        outside = np.array([window.start - 2e-3, window.end + 2e-3])
        assert not observable(scenario, window.index, outside).any()


def test_every_opportunity_lies_within_a_window() -> None:
    scenario = _table_4_3()
    found, stretches = opportunities(scenario, cadence=1.0, exposure=0.5), windows(scenario)
    for item in found:
        assert any(w.start - 2e-3 <= item.start and item.start + 0.5 <= w.end + 2e-3 for w in stretches)
    # The number of starts equals the number of grid points within the windows, so no start is missed.
    fit = sum(
        len([t for t in np.arange(np.ceil(w.start), w.end - 0.5)]) for w in stretches if w.end - w.start > 0.5
    )
    assert len(found) == fit
    assert opportunities(scenario, cadence=2.0, exposure=0.5) == [x for x in found if x.start % 2.0 == 0.0]


def test_a_wider_exclusion_leaves_fewer_opportunities() -> None:
    wide = replace(_table_4_3(), half_angle=_table_4_3().pinhole.half_diagonal)
    shaded = replace(wide, buffer=np.radians(60.0))
    counts = [len(opportunities(each, 1.0, 0.5)) for each in (_table_4_3(), wide, shaded)]
    assert counts[0] > counts[1] > counts[2] == 0


def test_the_object_is_in_the_frame_where_the_opportunity_has_it() -> None:
    scenario = _table_4_3()
    item = opportunities(scenario, cadence=1.0, exposure=0.5)[3]
    times, attitudes = exposure_attitudes(scenario, item.start, 0.5)
    tracks = source_tracks(scenario.camera, scenario.objects, scenario.epoch, times[0], times[-1])
    image = expected_electrons(StarCameraModel(), NO_STARS, [], times, attitudes, extra=tracks)
    assert image.sum() == pytest.approx(float(StarCameraModel().electrons(4.0, 0.5)), rel=1e-3)
    middle = 0.5 * (np.array(item.first) + np.array(item.last))
    assert centroid(image) == pytest.approx(middle, abs=0.3)
    # A rotation of 0.025 rad moves stars by 73 px, and the object by only a few px.
    assert np.hypot(*(np.array(item.last) - np.array(item.first))) == pytest.approx(73.0, abs=15.0)


def test_a_slew_that_follows_the_object_makes_the_stars_streak_and_not_the_object() -> None:
    camera, leader = _pair(0.1)
    rate = 2.0 * np.pi / KeplerianElements(semi_major_axis=7000e3).period
    start = camera.orbit.states_at(np.array([0.0]))[0]
    normal = np.cross(start[:3], start[3:])
    ahead = directions(camera.orbit.positions_at(np.zeros(1)), leader.orbit.positions_at(np.zeros(1)))[0]
    y = normal / np.linalg.norm(normal)
    attitude = quaternion.from_matrix(np.stack([np.cross(y, ahead), y, ahead]))
    times = np.linspace(0.0, 20.0, 201)
    slew = constant_slew(np.array([0.0, rate, 0.0]), attitude)(times)
    seen = (quaternion.attitude_matrix(slew) @ _direction(camera, leader, times)[..., None])[..., 0]
    assert seen == pytest.approx(np.tile([0.0, 0.0, 1.0], (201, 1)), abs=1e-6)


def _direction(camera: ResidentSpaceObject, other: ResidentSpaceObject, times: FloatArray) -> FloatArray:
    return directions(camera.orbit.positions_at(times), other.orbit.positions_at(times))


def test_a_search_that_would_never_end_is_refused() -> None:
    with pytest.raises(OutOfRange, match="cadence"):
        opportunities(_table_4_3(), cadence=0.0, exposure=0.5)
    with pytest.raises(OutOfRange, match="exposure"):
        opportunities(_table_4_3(), cadence=1.0, exposure=-0.5)
    with pytest.raises(OutOfRange, match="step"):
        windows(_table_4_3(), step=float("nan"))


HALF = np.radians(10.0)
CAMERA = np.array([[0.0, EARTH_RADIUS + 380e3, 0.0]])
SUN = np.array([[ASTRONOMICAL_UNIT, 0.0, 0.0]])


def _tilted(axis: FloatArray, towards: FloatArray, degrees: float) -> FloatArray:
    angle = np.radians(degrees)
    return np.asarray(np.cos(angle) * axis + np.sin(angle) * towards)


def test_the_boresight_is_the_cameras_z_through_its_mounting() -> None:
    """The boresight is the camera's axis z, rotated by the mounting.

    As in the errata to 2.16, the camera looks along body x, and the body is rotated by 90 deg about z.
    """
    body = quaternion.from_rotation_vector(np.array([[0.0, 0.0, 0.5 * np.pi]]))
    rows = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    mounting = quaternion.from_matrix(rows)
    assert boresights(body)[0] == pytest.approx([0.0, 0.0, 1.0])
    assert boresights(body, mounting)[0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)


def _below_horizontal(degrees: float) -> tuple[float, float, float]:
    angle = np.radians(degrees)
    return (5e6 * np.cos(angle), EARTH_RADIUS + 380e3 - 5e6 * np.sin(angle), 0.0)


@pytest.mark.parametrize(
    ("degrees", "excluded"), [(0.0, True), (10.26, True), (10.27, False), (170.0, False)]
)
def test_the_sun_spoils_a_frame_to_its_limb(degrees: float, excluded: bool) -> None:
    """A frame is spoilt if any part of the Sun's disc is in the field of view.

    The limit is half the field plus the Sun's radius of 0.2666 deg. The parallax of the Sun is at most 10".
    """
    boresight = _tilted(SUN / ASTRONOMICAL_UNIT, np.array([[0.0, 0.0, 1.0]]), degrees)
    assert sun_in_field(boresight, np.zeros((1, 3)), SUN, HALF)[0] == excluded


def test_the_sun_is_seen_from_the_camera_not_from_the_earths_centre() -> None:
    """The Sun is seen from the camera, not from the Earth's centre.

    At a distance of 4 million km from the Earth, the Sun is displaced by 1.5 deg.
    """
    aside = np.array([[0.0, 4e9, 0.0]])
    boresight = _tilted(SUN / ASTRONOMICAL_UNIT, np.array([[0.0, -1.0, 0.0]]), 11.0)
    assert sun_in_field(boresight, aside, SUN, HALF)[0]
    assert not sun_in_field(boresight, -aside, SUN, HALF)[0]


@pytest.mark.parametrize("above_limb", [9.9, 10.1, 25.0])
def test_the_earth_spoils_a_frame_to_its_limb(above_limb: float) -> None:
    """A frame is spoilt if the Earth's limb is in the field of view.

    At 380 km the horizon is 19.3 deg below the horizontal (Meller et al. 4.1: "20 deg").
    """
    dip = np.degrees(np.arccos(EARTH_RADIUS / np.linalg.norm(CAMERA)))
    assert dip == pytest.approx(19.3, abs=0.1)
    horizontal, up = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 1.0, 0.0]])
    boresight = _tilted(horizontal, up, above_limb - dip)
    assert earth_in_field(boresight, CAMERA, HALF)[0] == (above_limb < 10.0)


def test_a_buffer_widens_both() -> None:
    boresight = _tilted(SUN / ASTRONOMICAL_UNIT, np.array([[0.0, 1.0, 0.0]]), 15.0)
    assert not sun_in_field(boresight, CAMERA, SUN, HALF)[0]
    assert sun_in_field(boresight, CAMERA, SUN, HALF, buffer=np.radians(6.0))[0]
    assert not earth_in_field(boresight, CAMERA, HALF)[0]
    assert earth_in_field(boresight, CAMERA, HALF, buffer=np.radians(25.0))[0]


@pytest.mark.parametrize(
    ("target", "hidden"),
    [
        ((0.0, -7e6, 0.0), True),
        ((0.0, 9e6, 0.0), False),
        ((7e6, 0.0, 0.0), True),
        # Objects at a distance of 5000 km, 0.1 deg below and above the horizon, whose dip is 19.3 deg.
        (_below_horizontal(19.4), True),
        (_below_horizontal(19.2), False),
        # The object is straight below the camera, but above the ground, so the Earth does not hide it.
        ((0.0, EARTH_RADIUS + 1000.0, 0.0), False),
    ],
)
def test_the_earth_hides_what_is_behind_it(target: tuple[float, float, float], hidden: bool) -> None:
    """An object is hidden if and only if the line of sight to it passes through the Earth.

    The reference is the smallest distance from the Earth's centre of 100,000 points on the line.
    """
    end = np.array([target])
    way = CAMERA + np.linspace(0.0, 1.0, 100_001)[:, None] * (end - CAMERA)
    assert (np.linalg.norm(way, axis=1).min() < EARTH_RADIUS) == hidden
    assert hidden_by_earth(CAMERA, end)[0] == hidden
    assert hidden_by_earth(end, CAMERA)[0] == hidden


def test_the_field_ends_at_the_detectors_edge() -> None:
    pinhole = Pinhole.from_field_of_view(1024, 1024, 2.0 * HALF)
    attitude = quaternion.from_rotation_vector(np.array([0.3, -0.2, 0.9]))
    points = np.array([[511.5, 511.5], [-0.4, 511.5], [-0.6, 511.5], [1023.4, 1023.4], [1023.6, 1023.4]])
    seen = pinhole.unit_vectors(points) @ quaternion.attitude_matrix(attitude)
    attitudes = np.tile(attitude, (len(points), 1))
    assert in_field(pinhole, attitudes, seen).tolist() == [True, True, False, True, False]
    assert in_field(pinhole, attitudes, seen, margin=1.0).all()
    assert not in_field(pinhole, attitudes, -seen).any()
