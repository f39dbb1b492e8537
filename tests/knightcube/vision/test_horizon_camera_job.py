"""Tests of Sun and nadir from the horizon cameras and solar strings, and of masks of the structure."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.astro.quaternion import from_matrix
from knightcube.vision.camera.lens import MountedCamera, Pinhole
from knightcube.vision.horizon.nadir import HorizonStatus, find_nadir
from knightcube.vision.horizon.settings import HorizonKnowledge, RoughAttitude
from knightcube.vision.horizon_camera_job import (
    EARTHLIGHT_SIGMA,
    HorizonCameraJob,
    StructureMap,
    polygon_mask,
    run,
)
from knightcube.vision.solar_cells import SolarStringModel
from sim_hal.earth_camera import EarthScene, nadir, render
from tests.sim_hal.earth_camera.scenes import limb_scene
from tests.support.limb_frames import camera_model, finder_settings

SUN, NADIR = np.array([-0.59, 0.13, 0.80]), np.array([0.66, -0.62, -0.42])
SHARES = np.array([0.14, 0.14, 0.83, 0.61, 0.15, 0.11])
"""Currents of the strings relative to their peak currents. The Earth is opposite to the Sun, so it
illuminates +x and -y."""
CAMERA = MountedCamera(Pinhole.from_field_of_view(64, 64, 1.0), np.array([0.0, 0.0, 0.0, 1.0]))
POSITION, SUNWARD = np.array([-4e6, 4e6, -3.9e6]), np.array([0.2, 0.3, 0.9])


def attitude() -> FloatArray:
    """Return the attitude (4,) in which the nadir is NADIR."""

    def frame(first: FloatArray, second: FloatArray) -> FloatArray:
        x, z = first / np.linalg.norm(first), np.cross(first, second)
        z = z / np.linalg.norm(z)
        return np.stack([x, np.cross(z, x), z])

    return from_matrix(frame(NADIR, SUN).T @ frame(-POSITION, SUNWARD))


def off_deg(sigma: float) -> float:
    """Return the error (deg) of the Sun direction from strings, with an attitude known to `sigma` rad."""
    knowledge = HorizonKnowledge(position=POSITION, attitude=RoughAttitude(attitude(), sigma))
    dark = np.zeros((64, 64), dtype=np.uint8)
    found = run(HorizonCameraJob({0: dark}, (CAMERA,), knowledge, (SolarStringModel(), SHARES))).sun
    assert found is not None
    assert not found.cameras
    return float(np.degrees(np.arccos(found.direction @ SUN / np.linalg.norm(SUN))))


def test_a_rough_attitude_predicts_which_strings_the_earth_illuminates() -> None:
    assert off_deg(0.5 * EARTHLIGHT_SIGMA) < 3.0
    assert off_deg(2.0 * EARTHLIGHT_SIGMA) > 8.0


MODEL = camera_model()
SIZE = 128


def test_a_polygon_hides_the_pixels_inside_it_and_no_others() -> None:
    """A polygon hides exactly the pixels whose centres are inside. A triangle of 20 x 10 px has 100 px."""
    mask = polygon_mask(40, 60, [[(9.5, 4.5), (29.5, 4.5), (9.5, 14.5)]])
    assert abs(int(mask.sum()) - 100) <= 5
    rows, columns = np.nonzero(mask)
    assert (rows.min(), columns.min()) == (5, 10)
    assert mask[5, 28]
    assert not mask[14, 20]
    assert not polygon_mask(40, 60, []).any()


def frame(edge: float, mask: BoolArray | None = None, level: float = 60.0) -> Image:
    """Return a dark sky and a bright ground from the column `edge` on, partly hidden by a structure."""
    picture = np.where(np.arange(SIZE) < edge, 10.0, 180.0 + 20.0 * np.sin(np.arange(SIZE) + edge))
    picture = np.tile(picture, (SIZE, 1))
    return (picture if mask is None else np.where(mask, level, picture)).astype(np.uint8)


BOOM: BoolArray = polygon_mask(SIZE, SIZE, [[(-1.0, 40.0), (90.0, 40.0), (90.0, 70.0), (-1.0, 70.0)]])
EDGES = (20.0, 100.0, 40.0, 120.0, 5.0)


def learned(mask: BoolArray, frames: int = 40, level: float = 60.0) -> StructureMap:
    known = StructureMap.of(np.zeros_like(mask))
    for number in range(frames):
        known = known.after(frame(EDGES[number % len(EDGES)], mask, level))
    return known


@pytest.mark.parametrize("level", [10.0, 60.0, 180.0])
def test_structure_is_learned_while_the_limb_moves(level: float) -> None:
    """Dark, grey or bright structure is recognised while the limb moves.

    The mask of the structure is one block wider than the structure.
    """
    found = learned(BOOM, level=level).mask
    assert found is not None
    assert np.mean(found[BOOM]) > 0.9
    assert np.mean(found[~BOOM]) < 0.25


def test_a_limb_that_does_not_move_teaches_nothing() -> None:
    known = StructureMap.of(np.zeros_like(BOOM))
    for _ in range(100):
        known = known.after(frame(60.0, BOOM))
    assert known.mask is None


def test_a_mask_that_becomes_wrong_is_discarded_at_once() -> None:
    """A mask that has become wrong is discarded with the first frame that contradicts it.

    The structure was folded away, and the first frame without the structure is searched without a mask.
    """
    known = learned(BOOM)
    gone = known.after(frame(64.0))
    assert gone.mask is None or np.mean(gone.mask[BOOM]) < 0.1
    # If half of the image is equal in all frames, the cause is a limb that hardly moves, not the structure.
    large = learned(polygon_mask(SIZE, SIZE, [[(-1.0, -1.0), (128.0, -1.0), (128.0, 80.0), (-1.0, 80.0)]]))
    assert large.mask is None


def test_configured_structure_stays_hidden() -> None:
    """The blocks that a configured polygon touches stay hidden, even if their brightness changes."""
    known = StructureMap.of(BOOM)
    for edge in EDGES:
        known = known.after(frame(edge))
    mask = known.mask
    assert mask is not None
    assert mask[BOOM].all()
    assert np.mean(mask[~BOOM]) < 0.1


def test_a_lit_panel_hides_no_limb_with_its_mask_and_makes_none_alone() -> None:
    """A masked lit panel does not prevent the fit of the limb, and is not fitted as a horizon itself.

    The panel covers a sixth of the frame, on sky, limb and ground.
    """
    scene = limb_scene(zenith=np.array([1.0, 0.0, 1.0]), sun=np.array([1.0, 0.6, 0.5]), texture=3)
    mask = polygon_mask(512, 512, [[(60.0, -1.0), (250.0, -1.0), (210.0, 512.0), (110.0, 300.0)]])
    picture = np.where(mask, np.uint8(150), render(MODEL, scene, np.random.default_rng(1)))
    settings, knowledge = finder_settings(MODEL), _known(scene)
    found = find_nadir(picture, MODEL.lens, knowledge, settings, mask)
    assert found.status is HorizonStatus.FOUND, found.reason
    assert found.nadir is not None
    assert np.arccos(found.nadir.direction @ nadir(scene)) < 3.0 * found.nadir.sigma < np.radians(0.4)
    assert not mask[tuple(np.rint(found.points).astype(int).T[::-1])].any()
    blind = find_nadir(picture, MODEL.lens, knowledge, settings, np.ones_like(mask))
    assert blind.status is HorizonStatus.NO_HORIZON
    with pytest.raises(ValueError, match="give \\(512, 512\\)"):
        find_nadir(picture, MODEL.lens, knowledge, settings, mask[:100])


def _known(scene: EarthScene) -> HorizonKnowledge:
    return HorizonKnowledge(position=scene.position, sun=scene.sun, pole=scene.pole)
