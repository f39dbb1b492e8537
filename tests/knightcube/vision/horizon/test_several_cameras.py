"""Nadir of several cameras: one limb through all their points, and a coarse one where no limb is in view."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.directions import tangent_basis
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.vision.camera.lens import MountedCamera
from knightcube.vision.horizon.illumination import coarse_nadir, image_brightness
from knightcube.vision.horizon.limb_profile import UNIT_DEPTH_HEIGHT
from knightcube.vision.horizon.nadir import HorizonStatus
from knightcube.vision.horizon.settings import HorizonKnowledge, RoughAttitude, SensedDirection
from knightcube.vision.horizon.several_cameras import JointNadir, nadir_of_cameras
from sim_hal.earth_camera import EarthScene, render
from tests.studies.campaigns.nadir import camera_model, finder_settings
from tests.support.orbit_geometry import suite

MODEL = camera_model()
SETTINGS = finder_settings(MODEL)
UW = [MountedCamera(MODEL.lens, np.array(one.mounting)) for one in suite("uw").cameras]
VT = [MountedCamera(MODEL.lens, np.array(one.mounting)) for one in suite("vt").cameras]
EARTHLIGHT = 30.0
"""Counts: light of 0.025 in the logarithmic camera."""
ALTITUDE = 500e3


@dataclass(frozen=True, eq=False)
class Instant:
    """A satellite, its cameras' pictures, and what it knows."""

    attitude: FloatArray
    position: FloatArray
    sun: FloatArray
    scenes: list[EarthScene]
    frames: dict[int, Image]

    @property
    def nadir(self) -> FloatArray:
        """The truth (3,), body axes."""
        return np.asarray(attitude_matrix(self.attitude) @ (-self.position / np.linalg.norm(self.position)))

    @property
    def sun_in_body(self) -> FloatArray:
        """The truth (3,)."""
        return np.asarray(attitude_matrix(self.attitude) @ self.sun)

    def knowledge(self, sigma: float = 0.05) -> HorizonKnowledge:
        """Return GPS, the Sun's ephemeris, and a rough attitude."""
        rough = multiply(from_rotation_vector(np.array([0.6, -0.5, 0.6]) * sigma), self.attitude)
        return HorizonKnowledge(position=self.position, sun=self.sun, attitude=RoughAttitude(rough, sigma))


def instant(cameras: list[MountedCamera], nadir: FloatArray, sun: FloatArray, seed: int) -> Instant:
    """Return an instant above 53 deg north with nadir (3,), body axes, and the Sun (3,), inertial axes."""
    down = np.array([-0.6, 0.0, -0.8])
    position = -(6_378_137.0 + ALTITUDE) * down
    middle = nadir / np.linalg.norm(nadir) + down
    attitude = normalise(np.array([*middle, 0.0]))
    generator = np.random.default_rng(seed)
    scenes = [
        EarthScene(position, multiply(one.mounting, attitude), ASTRONOMICAL_UNIT * sun) for one in cameras
    ]
    frames = {number: render(MODEL, scene, generator) for number, scene in enumerate(scenes)}
    return Instant(attitude, position, sun / np.linalg.norm(sun), scenes, frames)


def error_deg(found: JointNadir, truth: FloatArray) -> float:
    """Return how far off a nadir is, deg."""
    assert found.nadir is not None, found.reason
    return float(np.degrees(np.linalg.norm(tangent_basis(truth) @ found.nadir.direction)))


@pytest.fixture(scope="module")
def level() -> Instant:
    """Return a level satellite by day: three cameras on the limb, the fourth on the sky."""
    return instant(UW, np.array([0.02, -0.03, 1.0]), np.array([0.8, 0.5, 0.3]), 11)


def test_the_cameras_together_know_nadir_better_than_any_one(level: Instant) -> None:
    found = nadir_of_cameras(level.frames, UW, level.knowledge(), SETTINGS)
    assert found.status is HorizonStatus.FOUND
    assert sorted(found.cameras) == [0, 1, 2]
    assert found.nadir is not None
    alone = [found.each[number].nadir for number in found.cameras]
    assert found.nadir.sigma < 0.5 * min(one.sigma for one in alone if one is not None)
    off = tangent_basis(level.nadir) @ found.nadir.direction
    assert error_deg(found, level.nadir) < 0.03
    assert float(np.linalg.norm(off)) < 4.0 * found.nadir.sigma


def test_a_sun_that_is_known_exactly_refuses_no_true_limb(level: Instant) -> None:
    """A cone through the edges is 0.1 to 0.3 deg off nadir before the limb is fitted; the Sun is not."""
    rough = level.knowledge()
    for sigma in (np.radians(0.005), np.radians(1.0)):
        seen = replace(rough, sensed=(SensedDirection(level.sun_in_body, level.sun, sigma),))
        found = nadir_of_cameras(level.frames, UW, seen, SETTINGS)
        assert found.status is HorizonStatus.FOUND, found.reason
        assert sorted(found.cameras) == [0, 1, 2]
    elsewhere = attitude_matrix(from_rotation_vector(np.array([0.0, 0.05, 0.0]))) @ level.sun_in_body
    false = replace(rough, sensed=(SensedDirection(elsewhere, level.sun, np.radians(0.005)),))
    assert nadir_of_cameras(level.frames, UW, false, SETTINGS).status is not HorizonStatus.FOUND


def test_air_higher_than_believed_shifts_one_cameras_nadir_but_not_that_of_three(level: Instant) -> None:
    """All three limbs 6 km higher: a single one tilts nadir by 0.13 deg, three opposite ones do not."""
    joint = nadir_of_cameras(level.frames, UW, level.knowledge(), SETTINGS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{nadir_of_cameras.__module__}.UNIT_DEPTH_HEIGHT", UNIT_DEPTH_HEIGHT - 6e3)
        shifted = nadir_of_cameras(level.frames, UW, level.knowledge(), SETTINGS)
        single = nadir_of_cameras({0: level.frames[0]}, UW, level.knowledge(), SETTINGS)
    assert error_deg(shifted, level.nadir) < 0.02 + error_deg(joint, level.nadir)
    assert error_deg(single, level.nadir) > 3.0 * error_deg(shifted, level.nadir)


def test_a_camera_that_says_otherwise_leaves_the_nadir_ambiguous(level: Instant) -> None:
    """Two cameras with each other's pictures, and no third one to decide, and no attitude."""
    frames = {0: level.frames[0], 1: np.ascontiguousarray(level.frames[1][::-1])}
    found = nadir_of_cameras(frames, UW, HorizonKnowledge(position=level.position), SETTINGS)
    assert found.nadir is None
    assert found.status is HorizonStatus.AMBIGUOUS
    assert "two horizons" in found.reason


def test_two_cameras_outvote_a_third(level: Instant) -> None:
    frames = {0: level.frames[0], 1: level.frames[1], 2: np.ascontiguousarray(level.frames[2][::-1])}
    found = nadir_of_cameras(frames, UW, HorizonKnowledge(position=level.position), SETTINGS)
    assert set(found.cameras) == {0, 1}
    assert error_deg(found, level.nadir) < 0.5


def test_one_camera_filled_and_the_others_dark_give_a_coarse_nadir() -> None:
    """The Earth's edge is 68 deg from nadir: a field of 33 deg half a side is full up to about 25 deg off."""
    boresight = VT[0].in_body(np.array([0.0, 0.0, 1.0]))
    aside = tangent_basis(boresight)
    for seed, off in enumerate((np.array([0.0, 0.0]), np.array([0.15, 0.1]))):
        nadir = boresight + off @ aside
        seen = instant(VT, nadir / np.linalg.norm(nadir), np.array([0.9, 0.3, 0.1]), seed)
        assert nadir_of_cameras(seen.frames, VT, seen.knowledge(), SETTINGS).nadir is None
        looks = [image_brightness(frame, VT[number], EARTHLIGHT) for number, frame in seen.frames.items()]
        assert [round(look.share, 1) for look in looks] == [1.0, 0.0, 0.0]
        coarse = coarse_nadir(looks, ALTITUDE, seen.sun_in_body)
        assert coarse is not None
        error = np.arccos(float(coarse.direction @ seen.nadir))
        assert np.degrees(error) < 20.0
        assert np.radians(5.0) < coarse.sigma < np.radians(16.0)
        assert error < 3.0 * coarse.sigma


def test_dark_pictures_give_no_coarse_nadir() -> None:
    dark = np.full((512, 512), 8, dtype=np.uint8)
    looks = [image_brightness(dark, camera, EARTHLIGHT) for camera in VT]
    assert coarse_nadir(looks, ALTITUDE, np.array([0.0, 0.0, 1.0])) is None
