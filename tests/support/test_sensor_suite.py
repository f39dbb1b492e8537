"""Tests that sensors of three satellites are mounted as in the paper, and that wrong files are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.schema.document import ConfigError
from knightcube.astro.arrays import FloatArray
from tests.support import sensor_suite
from tests.support.orbit_geometry import SUITES, suite

DOWN = np.array([0.0, 0.0, 1.0])


def boresights(name: str) -> FloatArray:
    """Return the boresights (n, 3) of the cameras, body axes."""
    return np.array([camera.to_camera[2] for camera in suite(name).cameras])


def angles(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(np.degrees(np.arccos(np.clip(first @ second.T, -1.0, 1.0))))


@pytest.mark.parametrize("name", SUITES)
def test_every_camera_is_the_paper_s_and_its_picture_hangs_right(name: str) -> None:
    """Every camera has 512 x 512 px over 67 deg, as in the paper, and its image is upright.

    The row numbers increase towards nadir, except if the camera looks up.
    """
    for camera in suite(name).cameras:
        assert (camera.columns, camera.rows, camera.field_of_view_deg) == (512, 512, 67.0)
        assert np.linalg.det(camera.to_camera) == pytest.approx(1.0)
        if camera.name != "top":
            assert camera.to_camera[1] @ DOWN > 0.7


@pytest.mark.parametrize("name", ["vt", "uw"])
def test_three_side_cameras_look_level_120_deg_apart(name: str) -> None:
    """Three side cameras look horizontally, 120 deg apart.

    In the paper (sections 4.1, 4.2), the cameras are on alternate sides, with 53 deg between their fields of
    view.
    """
    side = boresights(name)[:3]
    np.testing.assert_allclose(angles(side, side)[np.triu_indices(3, 1)], 120.0)
    np.testing.assert_allclose(side @ DOWN, 0.0, atol=1e-9)
    normals = np.array([string.normal for string in suite(name).solar_strings])
    assert np.all(np.max(side @ normals.T, axis=-1) > 1.0 - 1e-9)


def test_the_fourth_camera_of_uw_looks_out_of_the_top_and_vt_has_none() -> None:
    np.testing.assert_allclose(boresights("uw")[3], -DOWN, atol=1e-9)
    assert len(suite("vt").cameras) == 3


def test_vt_uses_its_cameras_for_the_earth_alone() -> None:
    """VT uses its cameras only for the Earth, and UW and USU for Earth and Sun (paper, section 1)."""
    assert not any(camera.sun for camera in suite("vt").cameras)
    assert all(camera.sun for name in ("uw", "usu") for camera in suite(name).cameras)


def test_the_cameras_of_usu_are_tipped_like_the_satellite() -> None:
    """The cameras of USU are tilted with the satellite.

    One camera is 55 deg from nadir, and the other cameras are 45 deg to either side of it (paper, section
    4.3).
    """
    middle, forward, aft = boresights("usu")
    assert angles(middle, DOWN) == pytest.approx(55.0)
    for other, turned in ((forward, 45.0), (aft, -45.0)):
        # A rotation by 45 deg about y rotates the component of the boresight normal to y by 45 deg.
        found = np.degrees(np.arctan2(other[0], other[2]) - np.arctan2(middle[0], middle[2]))
        assert found == pytest.approx(turned)
        assert other[1] == pytest.approx(middle[1])


def written(tmp_path: Path, old: str, new: str) -> Path:
    """Write the file of the suite VT with one replaced text; return its path."""
    text = Path("config/sensors/vt.yaml").read_text()
    assert old in text
    path = tmp_path / "suite.yaml"
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("name: side-3", "name: side-1", r"`cameras\[1\].name` is 'side-1', which stands twice"),
        ("[0.5, 0.5, 0.5, 0.5]", "[0.5, 0.5, 0.5, 0.6]", r"`cameras\[0\].mounting` has length 1.05"),
        ("[1.0, 0.0, 0.0]", "[2.0, 0.0, 0.0]", r"`solar_strings\[0\].normal` has length 2"),
        ("camera_rate_hz: 2.0", "camera_rate_hz: 0.0", "`camera_rate_hz` is 0.0"),
        ("camera_rate_hz: 2.0", "camera_rate: 2.0", "did you mean `camera_rate_hz`"),
        ("noise: 5.0e-8", "noise: .nan", "finite"),
    ],
)
def test_a_mistake_is_named_with_its_place(tmp_path: Path, old: str, new: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        sensor_suite.load(written(tmp_path, old, new))


def test_a_gyro_sample_is_the_noise_over_its_period() -> None:
    gyros = suite("uw").gyros
    assert gyros is not None
    assert gyros.sample_sigma == pytest.approx(gyros.noise * np.sqrt(2.0))
