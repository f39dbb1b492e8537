"""Objects of `simulation.objects`: where they are, how bright, and that the camera shows them."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np
import pytest

from flight.schema.document import ConfigError, config_path
from flight.schema.reader import load, simulation_section
from flight.schema.sections import Config
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.earth.sun import SPEED_OF_LIGHT, earth_velocity
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.lens import Pinhole
from sim_hal.clock import SimClock
from sim_hal.lockstep import posed_camera
from sim_hal.objects import Objects
from sim_hal.settings import (
    FreeBodySection,
    LineOfSight,
    ObjectState,
    Simulation,
    SkyObject,
    SkySection,
    Tumble,
)
from sim_hal.worlds.free_body import FreeBody
from sim_hal.worlds.world import OrbitingWorld

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
    """Return a frame of the configured camera at rest, and its attitude matrix."""
    text = config_path("step_demo").read_text()
    section = simulation_section(text, "step_demo", Simulation)
    assert section is not None
    changed = Simulation(release=section.release, sky=SkySection(magnitude_limit=0.0), objects=objects)
    clock = SimClock()
    device, attitude = posed_camera(config, changed, clock, np.zeros(3))
    device.trigger(round(EXPOSURE * 1e9))
    clock.sleep_until_ns(2_000_000_000)
    frame = device.poll()
    assert frame is not None
    return frame.pixels.astype(float), attitude_matrix(attitude(0))


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
    # It starts at the boresight, and its light is even: the middle lies half a length from there.
    weights, places = light[rows, columns], np.stack([columns, rows], axis=1).astype(float)
    middle = np.average(places, axis=0, weights=weights)
    assert np.hypot(*(middle - (camera.columns - 1) / 2)) == pytest.approx(length / 2, abs=0.5)
    # An even line of length L has the variance L^2 / 12 along it; across it lies the spot alone.
    across, along = np.linalg.eigvalsh(np.cov(places.T, aweights=weights))
    assert np.sqrt(12.0 * (along - across)) == pytest.approx(length, rel=0.05)


def test_an_object_in_orbit_is_shifted_by_its_motion_relative_to_the_camera_alone() -> None:
    """Planetary aberration: of two bodies that go with the Earth the Earth's own velocity does not count."""
    world = _world()
    around = world.surroundings()
    position, velocity = np.array(around.position), np.array(around.velocity)
    away = np.array(around.sun) * 30e3 + position / np.linalg.norm(position) * 100e3
    other = position + away
    sideways = np.cross(away, velocity)
    own = velocity + 900.0 * sideways / np.linalg.norm(sideways)
    state = ObjectState(position=tuple(other.tolist()), velocity=tuple(own.tolist()))
    objects = Objects([SkyObject(magnitude=4.0, state=state)], UTC, 0, world)
    (track,) = objects.tracks(0, np.array([0.0, 0.25, 0.5]))
    assert track.magnitude == pytest.approx(4.0, abs=0.01)
    geometric = away / np.linalg.norm(away)
    date = 2_440_587.5 + world.utc_ns() * 1e-9 / 86_400.0
    shown = track.directions[0] + (earth_velocity(date) + velocity) / SPEED_OF_LIGHT
    expected = geometric + (velocity - own) / SPEED_OF_LIGHT
    assert np.linalg.norm(np.cross(shown, expected)) < 1e-7
    turned = np.arccos(np.clip(track.directions[0] @ track.directions[-1], -1.0, 1.0))
    assert turned / 0.5 == pytest.approx(900.0 / np.linalg.norm(away), rel=0.02)


def test_a_tumbling_object_is_as_bright_as_its_mean_light_over_the_exposure() -> None:
    line = LineOfSight(right_ascension_deg=10.0, declination_deg=20.0, rate_deg=0.1)
    entries = [
        SkyObject(magnitude=3.0, line_of_sight=line, tumble=Tumble(period=400.0, amplitude=1.0)),
        SkyObject(magnitude=3.0, line_of_sight=line, tumble=Tumble(period=0.5, amplitude=1.0)),
    ]
    objects = Objects(entries, UTC, 0, _world())
    objects.begin(5_000_000_000)
    slow, fast = objects.tracks(105_000_000_000, np.array([0.0, 0.5]))
    assert slow.magnitude == pytest.approx(4.0, abs=1e-4)
    # The mean of exp(x sin) over a turn is the modified Bessel function I0: I0(0.921) = 1.2236.
    assert fast.magnitude == pytest.approx(3.0 - 2.5 * np.log10(1.2236), abs=1e-3)
    # Mission time 100 s at 0.1 deg/s: 10 deg from where it began, due north.
    assert np.degrees(np.arcsin(slow.directions[0, 2])) == pytest.approx(30.0, abs=1e-9)


def test_an_object_without_place_or_an_orbit_on_the_testbed_is_refused() -> None:
    line, state = (
        LineOfSight(right_ascension_deg=0.0, declination_deg=0.0),
        ObjectState(position=(7e6, 0.0, 0.0), velocity=(0.0, 7.5e3, 0.0)),
    )
    for entry in (SkyObject(magnitude=3.0), SkyObject(magnitude=3.0, line_of_sight=line, state=state)):
        with pytest.raises(ConfigError, match=r"objects\[0\].*either"):
            Objects([entry], UTC, 0, _world())
    with pytest.raises(ConfigError, match="orbit"):
        Objects([SkyObject(magnitude=3.0, state=state)], UTC, 0, object())  # type: ignore[arg-type] # no world


def test_the_objects_of_the_documentation_are_read() -> None:
    page = Path("docs/fly/simulation.md").read_text()
    block = page.split("<!-- read by: tests/sim_hal/orbit/test_objects.py -->\n```yaml\n")[1].split("```")[0]
    section = simulation_section("simulation:\n" + textwrap.indent(block, "  "), "page", Simulation)
    assert section is not None
    Objects(section.objects, section.utc, 0, _world())
    assert [entry.magnitude for entry in section.objects] == [3.0, 4.5]
