"""Tests that reference methods give the recorded results of small problems to five digits."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.catalogue import load
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.gnc.guidance.plant import PathSample
from knightcube.reference import star_tables
from knightcube.reference.control import AdaptiveController, AdaptiveSettings, PidController, PidSettings
from knightcube.reference.corner_streak_rate import estimate_rate
from knightcube.reference.corner_streaks import DETECTOR_NAMES, DetectorName, StreakSettings
from knightcube.reference.horizon import (
    circle_nadir,
    fit_circle,
    horizon_plane_depth,
    propagated_nadir,
    scan_horizon,
)
from knightcube.reference.star_identification import (
    DEFAULT_METHOD,
    METHODS,
    ClassicalSettings,
    PreviousAttitude,
    StarMotion,
    identify_by_rate,
    shared_rate,
)
from knightcube.reference.star_tables import KnownSky
from knightcube.vision.startracker.index import SkyIndex, TriangleIndex, choose_guide_stars
from knightcube.vision.startracker.index.build import default_index
from sim_hal.earth_camera import render
from tests.sim_hal.earth_camera.scenes import limb_scene
from tests.support.flights import demo_config
from tests.support.limb_frames import camera_model
from tests.support.recorded_results import check
from tests.support.star_lists import ListKind, StarList, draw, draw_random
from tests.support.streak_frames import rate_at, star_camera, star_frame

CLASSICAL = sorted(set(METHODS) - {DEFAULT_METHOD})
FIELD_DEG = 30.0


@lru_cache(maxsize=1)
def sky() -> KnownSky:
    """Return the bright guide stars of a wide field."""
    stars = choose_guide_stars(load(), 4.6, 2026.5, float(np.deg2rad(0.05)))
    none = TriangleIndex(np.zeros(0, np.uint32), np.zeros((0, 3), np.uint16), np.zeros((0, 2), np.uint8))
    half = float(np.tan(np.deg2rad(0.5 * FIELD_DEG)))
    return KnownSky(SkyIndex(stars, np.zeros((len(stars), 3), np.float32), none), (half, half))


def kind() -> ListKind:
    """Return the kind of star lists with two false stars, and with a tenth of the true stars missing."""
    faintest = float(sky().stars.magnitude[-1])
    return ListKind(
        field_deg=FIELD_DEG, noise_px=0.2, known_deg=0.05, faintest=faintest, false_stars=2, lost=0.1
    )


def drawn(seed: int) -> StarList:
    """Return a random star list of a seed."""
    return draw(kind(), sky().index.stars, np.random.default_rng(seed))


def check_identified(name: str) -> None:
    """Compare a method's results for lists of the sky and for random lists with the recorded results."""
    found = [METHODS[name].identify(drawn(seed).field(), sky()) for seed in (1, 2)]
    found.append(METHODS[name].identify(draw_random(kind(), 12, np.random.default_rng(3)).field(), sky()))
    check(__file__, f"identified {name}", found)


def test_the_identification_by_spherical_triangles_is_as_recorded() -> None:
    check_identified("spherical-triangle")


@pytest.mark.parametrize("name", [name for name in CLASSICAL if name != "spherical-triangle"])
def test_the_identification_by_a_classical_method_is_as_recorded(name: str) -> None:
    check_identified(name)


def moving(seed: int) -> tuple[StarList, FloatArray, StarMotion]:
    """Return a star list, its directions and its motion; the motion of one star is wrong."""
    one = drawn(seed)
    rng = np.random.default_rng(seed)
    direction = one.field().direction
    velocity = np.cross(direction, np.array([0.01, -0.02, 0.015])) + 1e-4 * rng.normal(size=direction.shape)
    velocity[3] += 0.01
    return one, direction, StarMotion(velocity, np.full(len(direction), 1e-4))


def test_the_rate_that_most_points_share_is_as_recorded() -> None:
    _, direction, motion = moving(4)
    check(__file__, "shared rate", shared_rate(direction, motion))


def test_the_identification_by_the_rate_is_as_recorded() -> None:
    one, _, motion = moving(5)
    turn = from_rotation_vector(np.array([0.01, -0.02, 0.015]) * -0.5)
    previous = PreviousAttitude(multiply(turn, one.attitude), 1e-3, 0.5)
    found = [
        identify_by_rate(one.field(), sky(), ClassicalSettings(), motion, before)
        for before in (None, previous)
    ]
    check(__file__, "by rate", found)


def test_the_tables_of_pairs_triangles_and_grids_are_as_recorded() -> None:
    known = sky()
    tables: dict[str, Any] = {
        name: getattr(known, name) for name in ("pairs", "planar", "spherical", "grid", "widest")
    }
    check(__file__, "tables", tables)


def test_the_shapes_of_measured_triangles_are_as_recorded() -> None:
    rng = np.random.default_rng(6)
    corners = rng.normal(size=(7, 3, 3)) * 0.1 + [0.0, 0.0, 1.0]
    corners /= np.linalg.norm(corners, axis=2, keepdims=True)
    sigma = 1e-4 * rng.uniform(0.5, 2.0, (7, 3))
    found = [
        star_tables.planar_shape(corners),
        star_tables.spherical_shape(corners),
        star_tables.measured_planar_shape(corners, sigma),
        star_tables.measured_spherical_shape(corners, sigma),
        star_tables.side_lengths(corners),
    ]
    check(__file__, "shapes", found)


def samples() -> list[tuple[PathSample, float, float]]:
    """Return commanded motions with the measured angles and rates."""
    found = []
    for k in range(60):
        t = 0.1 * k
        wanted = PathSample(0.3 * np.sin(t), 0.3 * np.cos(t), -0.3 * np.sin(t))
        found.append(
            (wanted, 0.3 * np.sin(t) - 0.02 * np.cos(2.0 * t), 0.3 * np.cos(t) + 0.01 * np.sin(3.0 * t))
        )
    return found


def test_the_commands_of_the_reference_controllers_are_as_recorded() -> None:
    from flight.bodies.testbed.control import plant_of  # noqa: PLC0415 - only here

    plant = plant_of(demo_config(1.0))
    controllers: dict[str, Any] = {
        "pid": PidController(plant, 0.1, PidSettings.placed(0.4), 0.6),
        "adaptive": AdaptiveController(plant, 0.1, AdaptiveSettings(0.5, 2.0, None)),
        "reference model": AdaptiveController(plant, 0.1, AdaptiveSettings(0.5, 2.0, 0.6)),
    }
    found: dict[str, Any] = {}
    for name, controller in controllers.items():
        commands = [controller.command(*sample)._asdict() for sample in samples()]
        found[name] = [commands[::6], getattr(controller, "parameters", None)]
        controller.reset()
        found[f"{name} after a reset"] = controller.command(*samples()[5])._asdict()
    check(__file__, "controllers", found)


def test_the_scanned_horizon_is_as_recorded() -> None:
    model = camera_model()
    scene = limb_scene(zenith=np.array([1.0, 0.2, 1.0]), sun=np.array([1.0, 0.6, 0.5]), texture=3)
    frame = render(model, scene, np.random.default_rng(3))
    scanned = scan_horizon(frame, model.lens)
    check(__file__, "scanned", [scanned, circle_nadir(scanned.circle, model.lens, 600e3)])


def test_circles_and_propagated_nadirs_are_as_recorded() -> None:
    rng = np.random.default_rng(7)
    angle = rng.uniform(0.0, 2.0, 30)
    points = 200.0 + 90.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.normal(0.0, 0.5, (30, 2))
    circle = fit_circle(points)
    before, after = np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.28, 0.96])
    nadir = propagated_nadir(np.array([0.0, 0.6, 0.8]), before, after)
    depth = [horizon_plane_depth(altitude) for altitude in (300e3, 900e3)]
    check(__file__, "circle", [circle, circle.distances(points), nadir, depth])


def test_the_default_method_identifies_by_the_index_of_the_sky() -> None:
    rng = np.random.default_rng(9)
    stars = default_index().stars
    one = draw(ListKind(14.0, noise_px=0.1, known_deg=0.0, faintest=6.0), stars, rng)
    found = METHODS[DEFAULT_METHOD].identify(one.field(), KnownSky(default_index(), one.field().half_width))
    claimed = found.star >= 0
    assert np.count_nonzero(claimed) > 5
    np.testing.assert_array_equal(found.star[claimed], one.star[claimed])


CAMERA = star_camera(400)
RATE = rate_at(1.2, 0.04, 0.7)


@pytest.fixture(scope="module")
def pixels() -> Image:
    return star_frame(CAMERA, RATE, 1.0, 4, faintest=6.0)


@pytest.mark.parametrize("name", DETECTOR_NAMES)
def test_the_rate_by_a_detector_is_as_recorded(pixels: Image, name: DetectorName) -> None:
    settings = StreakSettings.of(name)
    check(__file__, f"rate {name}", estimate_rate(pixels, CAMERA.pinhole, 1.0, settings, RATE, 1e-3))


def test_the_rate_without_a_prior_is_as_recorded(
    pixels: Image,
) -> None:
    check(__file__, "no prior", estimate_rate(pixels, CAMERA.pinhole, 1.0, StreakSettings()))


def test_the_rate_about_the_boresight_is_as_recorded() -> None:
    rate = rate_at(0.1, 0.25, 1.0)
    frame = star_frame(CAMERA, rate, 1.0, 6, faintest=6.0)
    check(__file__, "boresight", estimate_rate(frame, CAMERA.pinhole, 1.0, StreakSettings(), rate, 1e-3))
