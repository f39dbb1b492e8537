"""Tests of the Basilisk world against `free_body`, which are skipped if Basilisk is not installed."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest

from flight.schema import reader
from flight.schema.document import ConfigError
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from sim_hal.settings import Disturbances, FreeBodySection, OrbitSection
from sim_hal.worlds.basilisk.world import BasiliskWorld, make
from sim_hal.worlds.free_body import CoilSupply, FreeBody
from sim_hal.worlds.world import OrbitingWorld, WorldInputs, make_world
from tests.support.flights import demo_config, demo_world

SECOND = 1_000_000_000
UTC = "2026-03-20T12:00:00Z"
POWER = CoilSupply((23.0, 23.0, 23.0), 3.4)
CALM = Disturbances(drag=0.0, solar_pressure=0.0, residual_dipole=0.0, ring_current=0.0)


def both(
    section: FreeBodySection, currents: Callable[[], FloatArray], seed: int = 4
) -> tuple[BasiliskWorld, FreeBody]:
    pytest.importorskip("Basilisk", reason="Basilisk is not installed (extra `worlds`)")
    theirs = BasiliskWorld(section, currents, POWER, seed, UTC, 0)
    ours = FreeBody(section, currents, POWER, seed, UTC, 0)
    for world in (theirs, ours):
        world.release_at(SECOND)
    return theirs, ours


def test_orbit_field_and_rotation_agree_with_the_world_free_body() -> None:
    """Two worlds with coils and gravity gradient agree in orbit, field and rotation.

    Degree 13 of IGRF-14, which WMM2025 does not have, changes the attitude by a milliradian.
    """
    currents = [np.array([0.05, -0.03, 0.02])]
    theirs, ours = both(FreeBodySection(craft="cubesat_3u", disturbances=CALM), lambda: currents[0])
    for second in range(1, 121):
        currents[0] = np.array([0.05 * np.sin(0.1 * second), -0.03, 0.02])
        for world in (theirs, ours):
            world.motion(second * SECOND)
    a, b = theirs.surroundings(), ours.surroundings()
    np.testing.assert_allclose(a.position, b.position, atol=5.0)
    np.testing.assert_allclose(a.velocity, b.velocity, atol=0.05)
    np.testing.assert_allclose(a.field, b.field, atol=1e-7)
    np.testing.assert_allclose(a.sun, b.sun, atol=1e-6)
    one, two = theirs.motion(120 * SECOND), ours.motion(120 * SECOND)
    assert quaternion.angle_between(one.quaternion, two.quaternion) < 0.02
    np.testing.assert_allclose(one.rate, two.rate, atol=5e-4)
    np.testing.assert_allclose(one.field_body, two.field_body, atol=1e-6)
    assert theirs.truth().energy == pytest.approx(ours.truth().energy, rel=0.01)


def test_disturbances_rotate_the_body_as_in_the_world_free_body() -> None:
    """Disturbances rotate the body equally in both worlds.

    Sunlight, dipoles and drag act for five minutes on a body that was at rest.
    """
    body = FreeBodySection(
        orbit=OrbitSection(local_time=12.0), disturbances=Disturbances(gravity_gradient=0.0)
    )
    theirs, ours = both(
        reader.replace(body, release=reader.replace(body.release, speed=0.0)), lambda: np.zeros(3)
    )
    for world in (theirs, ours):
        for second in range(1, 200):
            world.motion(second * SECOND)
    one, two = theirs.motion(200 * SECOND), ours.motion(200 * SECOND)
    assert np.linalg.norm(two.rate) > 1e-3
    assert np.linalg.norm(one.rate - two.rate) < 0.2 * np.linalg.norm(two.rate)


def test_a_configuration_selects_the_basilisk_world_with_the_devices_of_an_orbit() -> None:
    pytest.importorskip("Basilisk", reason="Basilisk is not installed (extra `worlds`)")
    section = reader.replace(
        demo_world(), world="sim_hal.worlds.basilisk.world:make", free_body=FreeBodySection()
    )
    world = make_world(WorldInputs(demo_config(1.0, camera=False), section, lambda: np.zeros(3), 0))
    assert isinstance(world, OrbitingWorld)


def test_without_basilisk_the_package_to_install_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("Basilisk")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "sim_hal.worlds.basilisk.scenario", raising=False)
    monkeypatch.setitem(sys.modules, "Basilisk", None)
    section = reader.replace(demo_world(), free_body=FreeBodySection())
    inputs = WorldInputs(demo_config(1.0, camera=False), section, lambda: np.zeros(3), 0)
    with pytest.raises(ConfigError, match=r"knightcube-flight\[worlds\]"):
        make(inputs)
    with pytest.raises(ConfigError, match="free_body"):
        make(WorldInputs(inputs.config, demo_world(), lambda: np.zeros(3), 0))
