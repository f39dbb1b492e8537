"""Tests of the sky index: triangles against geometry, and damaged files."""

from __future__ import annotations

import math
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from knightcube.astro import catalogue
from knightcube.astro.quaternion import attitude_matrix, normalise
from knightcube.errors import ArgumentError, InputError, UsageError
from knightcube.vision.star_tracker import StarTracker
from knightcube.vision.startracker.index import (
    CELLS,
    FINE,
    LEAST_RATIO,
    OCTAVE,
    PATH,
    RUN_BITS,
    SIZES,
    TIE,
    build_triangles,
    load,
    reach,
    save,
)
from knightcube.vision.startracker.index import build as index_build
from knightcube.vision.startracker.index.build import IndexSettings, default_index
from tests.pace import ordinary_seconds

SMALL = IndexSettings(faintest=5.0, smallest=float(np.deg2rad(8.0)), density=4.0)


def _strewn(count: int, seed: int = 1) -> np.ndarray:
    vectors = np.random.default_rng(seed).standard_normal((count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def test_the_reach_of_a_star_is_the_distance_of_its_nth_brighter_neighbour() -> None:
    direction = _strewn(400)
    found = reach(direction, 5, 0.9)
    for star in range(400):
        brighter = np.sort(np.linalg.norm(direction[:star] - direction[star], axis=-1))
        expected = brighter[4] if star >= 5 else 0.9
        assert np.isclose(found[star], min(expected, 0.9)), star


def test_only_a_reach_below_the_useful_one_is_left_out() -> None:
    """Ranges of triangles that are too small to be useful are omitted, and all other ranges are unchanged.

    Half of the stars are random. The other half of the stars is concentrated in regions with many or few
    bright stars.
    """
    near = np.array([0.0, 0.0, 1.0]) + 0.05 * _strewn(2000, 2)
    both = np.concatenate([near / np.linalg.norm(near, axis=-1, keepdims=True), _strewn(2000)])
    direction = np.random.default_rng(3).permutation(both)
    whole, useful = reach(direction, 5, 0.9), reach(direction, 5, 0.9, 0.5)
    assert (useful[whole >= 0.5] == whole[whole >= 0.5]).all()
    assert (useful[whole < 0.5] < 0.5).all()
    assert np.mean(useful == 0.0) > 0.5, "the choice saves no time"


def test_the_triangles_are_those_of_enumeration() -> None:
    direction = _strewn(60)
    sizes, ranks = np.array([0.3, 0.5, 0.9]), np.array([4, 6])
    found = {tuple(sorted(row)) for row in build_triangles(direction, sizes, ranks, 0).corners.tolist()}
    expected = set()
    limits = [reach(direction, rank, top) for rank, top in zip(ranks, sizes[1:], strict=True)]
    for a in range(60):
        for b in range(a + 1, 60):
            for c in range(b + 1, 60):
                side = [np.linalg.norm(direction[p] - direction[q]) for p, q in ((a, b), (b, c), (c, a))]
                band = np.searchsorted(sizes, max(side), side="right") - 1
                if not 0 <= band < 2 or min(side) < LEAST_RATIO * max(side):
                    continue
                if max(side) <= min(limits[band][[a, b, c]]) * (1.0 + TIE):
                    expected.add((a, b, c))
    assert found == expected


def test_any_circle_has_triangles_of_its_brightest_stars_beside_a_cluster_too() -> None:
    """Any circle contains triangles of its brightest stars, even beside a cluster.

    The hundred stars of the cluster are brighter than all other stars, so that stars nearby have low
    brightness ranks.
    """
    near = np.array([0.0, 0.0, 1.0]) + 0.05 * _strewn(100, 2)
    direction = np.concatenate([near / np.linalg.norm(near, axis=-1, keepdims=True), _strewn(3000)])
    sizes, ranks = np.array([0.2, 0.3, 0.5]), np.array([4, 6])
    centre = np.array([np.sin(0.3), 0.0, np.cos(0.3)])
    inside = np.flatnonzero(np.linalg.norm(direction - centre, axis=-1) < 0.25)

    def triangles(few: int) -> int:
        corners = build_triangles(direction, sizes, ranks, few).corners
        return int(np.isin(corners, inside).all(axis=1).sum())

    assert triangles(0) < 5
    assert triangles(5) >= 10


def test_a_rotated_sky_has_the_same_triangles() -> None:
    """A rotated sky has the same triangles, despite rounding errors.

    A star is a corner only of triangles that are smaller than its range, the distance to a brighter
    neighbour. Rounding errors of this distance must not change the choice of triangles.
    """
    direction = _strewn(60)
    sizes, ranks = np.array([0.3, 0.5, 0.9]), np.array([4, 6])
    first = np.unique(np.sort(build_triangles(direction, sizes, ranks, 0).corners, axis=1), axis=0)
    for quaternion in normalise(np.random.default_rng(4).standard_normal((6, 4))):
        turned = direction @ attitude_matrix(quaternion).T
        found = np.unique(np.sort(build_triangles(turned, sizes, ranks, 0).corners, axis=1), axis=0)
        np.testing.assert_array_equal(found, first)


def test_an_entry_depends_on_shape_and_size_of_its_triangle() -> None:
    sky = default_index()
    triangles = sky.triangles
    some = np.random.default_rng(3).integers(0, len(triangles), 500)
    corners = sky.stars.direction[triangles.corners[some].astype(int)]
    sides = np.linalg.norm(corners[:, [1, 2, 0]] - corners[:, [2, 0, 1]], axis=-1)
    assert np.all(np.diff(sides, axis=1) >= 0.0)
    entry = triangles.entry[some].astype(np.int64)
    form = np.searchsorted(triangles.begin, some, side="right") - 1
    cells = np.stack([form // CELLS % CELLS, form % CELLS], axis=-1)
    fine = np.stack([entry // FINE % FINE, entry % FINE], axis=-1)
    ratio = (cells + (fine + 0.5) / FINE) / CELLS
    assert np.allclose(ratio, sides[:, :2] / sides[:, 2:], atol=1.0 / (CELLS * FINE))
    size = 2.0 ** (((entry >> 16) + 0.5 - SIZES) / OCTAVE)
    assert np.allclose(size, sides[:, 2], rtol=1.0 / OCTAVE)
    left = np.linalg.det(corners) > 0.0
    assert np.array_equal(form // CELLS**2 == 1, left)


def test_entries_of_a_form_between_two_sizes_are_contiguous() -> None:
    """The table `below` contains the number of entries below each interval, as found by a search."""
    triangles = default_index().triangles
    form = np.repeat(np.arange(len(triangles.begin) - 1), np.diff(triangles.begin))
    whole = form * SIZES + (triangles.entry >> np.uint32(16))
    assert np.all(np.diff(whole) >= 0)
    intervals = np.random.default_rng(4).integers(0, len(triangles.below) - 1, 300)
    expected = np.searchsorted(whole, intervals << RUN_BITS)
    assert np.array_equal(triangles.below[intervals], expected)
    assert triangles.below[-1] == len(triangles)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sky") / "sky.index"
    save(index_build.build(SMALL), path)
    return path


def test_an_index_file_round_trips_and_is_deterministic(stored: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.index"
    sky = index_build.build(SMALL)
    save(sky, again)
    assert again.read_bytes() == stored.read_bytes()
    back = load(stored)
    assert np.array_equal(back.triangles.entry, sky.triangles.entry)
    assert np.array_equal(back.triangles.corners, sky.triangles.corners)
    assert np.abs(back.stars.direction - sky.stars.direction).max() < 1e-7
    assert np.abs(back.stars.magnitude - sky.stars.magnitude).max() < 1e-3


def test_two_threads_write_the_same_index_file(
    stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    both, replaced, sky = threading.Barrier(2), Path.replace, index_build.build(SMALL)

    def replace_together(self: Path, target: Path) -> Path:
        both.wait(60.0)
        return replaced(self, target)

    monkeypatch.setattr(Path, "replace", replace_together)
    copy = tmp_path / "copy.index"
    with ThreadPoolExecutor(2) as pool:
        for done in [pool.submit(save, sky, copy) for _ in range(2)]:
            done.result()
    assert copy.read_bytes() == stored.read_bytes()
    assert list(tmp_path.iterdir()) == [copy]


def test_an_index_that_cannot_be_stored_leaves_no_file(stored: Path, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        save(load(stored), tmp_path / "folder")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_a_star_tracker_uses_an_index_that_was_built_saved_and_loaded(stored: Path) -> None:
    sky = load(str(stored))
    assert repr(sky).startswith("<SkyIndex: <GuideStars: 1615 stars to V 5.0, epoch 2026.5>")
    for index in (sky, stored, str(stored)):
        found = StarTracker(fov_deg=20.0, index=index).solve(np.zeros((64, 64)))
        assert len(found.index.stars) == len(sky.stars)
    with pytest.raises(ArgumentError, match="index: 5: give a SkyIndex or the path"):
        StarTracker(index=5)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"faintest": 12.0}, "faintest: 12: give a V magnitude up to 8.5"),
        ({"faintest": np.nan}, "faintest: nan"),
        ({"epoch": 1e6}, "epoch: 1e+06: give a Julian year from 1900 to 2200"),
        ({"epoch": np.nan}, "epoch: nan"),
        ({"resolution": -1.0}, "resolution: -1 rad: give 0 to"),
        ({"smallest": 0.5}, "smallest: 0.5 rad, largest 0.436332 rad: give increasing angles"),
    ],
)
def test_settings_out_of_range_are_refused(given: dict[str, float], message: str) -> None:
    with pytest.raises(ArgumentError, match=re.escape(message)):
        IndexSettings(**given)  # type: ignore[arg-type]  # of numbers


def test_a_pixel_out_of_range_is_refused() -> None:
    for pixel in (-1.0, 0.0, np.nan, 0.1):
        with pytest.raises(ArgumentError, match=r"pixel: .* rad: give more than 0 and less than a sixteenth"):
            IndexSettings.of_field(0.2, pixel)


@pytest.mark.parametrize(
    ("fov_deg", "faintest", "message"),
    [
        (
            20.0,
            2.0,
            "48 stars to V 2, a mean of 0.5 in a field of 20 deg, but a fix needs 4: give fainter stars",
        ),
        (60.0, 0.0, "4 stars to V 0"),
        (10.0, 4.0, "a mean of 1.3 in a field of 10 deg"),
        (20.0, -9.0, "0 stars to V -9"),
    ],
)
def test_an_index_with_too_few_stars_is_refused(fov_deg: float, faintest: float, message: str) -> None:
    settings = replace(IndexSettings.of_field(math.radians(fov_deg)), faintest=faintest)
    with pytest.raises(UsageError, match=re.escape(message)):
        index_build.build(settings)


@pytest.mark.parametrize("place", [12, 200, -1])
def test_a_flipped_bit_is_reported_with_its_cure(stored: Path, tmp_path: Path, place: int) -> None:
    damaged = bytearray(stored.read_bytes())
    damaged[place] ^= 1
    path = tmp_path / "damaged.index"
    path.write_bytes(damaged)
    with pytest.raises(InputError, match=r"damaged.*startracker\.index\.build"):
        load(path)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "cannot|no sky index"),
        (b"nonsense" * 20, "not a sky index"),
        (b"KCSKYIDX" + b"\x63" * 40, "version"),
    ],
    ids=["empty", "another-file", "another-version"],
)
def test_a_file_of_another_kind_is_refused_with_advice(tmp_path: Path, content: bytes, problem: str) -> None:
    path = tmp_path / "other.index"
    path.write_bytes(content)
    with pytest.raises(InputError, match=problem):
        load(path)
    with pytest.raises(InputError, match="the sky index cannot be read"):
        load(tmp_path / "missing.index")


def test_a_truncated_file_is_refused(stored: Path, tmp_path: Path) -> None:
    path = tmp_path / "short.index"
    path.write_bytes(stored.read_bytes()[:-100])
    with pytest.raises(InputError, match="damaged"):
        load(path)


def test_loading_the_whole_index_takes_less_than_50_ms() -> None:
    default_index()
    assert ordinary_seconds(lambda: load(PATH)) < 0.05


def test_the_stars_move_to_another_epoch_by_their_proper_motion() -> None:
    """At another epoch, the stars are displaced by their proper motion.

    Groombridge 1830, HIP 57939, moves by 7.06 arcsec per year.
    """
    sky = default_index()
    (star,) = np.flatnonzero(sky.stars.hip == 57939)
    later = sky.at(sky.stars.epoch + 10.0).stars.direction[star]
    moved = np.rad2deg(np.linalg.norm(later - sky.stars.direction[star])) * 3600.0
    assert abs(moved - 70.6) < 0.3
    truth = catalogue.load()
    (source,) = np.flatnonzero(truth.hip == 57939)
    assert np.linalg.norm(truth.directions_at(sky.stars.epoch + 10.0)[source] - later) < 1e-6
    with pytest.raises(ValueError, match="epoch"):
        sky.at(float("nan"))


def test_the_command_writes_an_index_and_describes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "folder" / "small.index"
    assert index_build.main(["--output", str(path), "--faintest", "4.5"]) == 0
    assert "triangles" in capsys.readouterr().out
    assert len(load(path).stars) > 500
    assert index_build.main(["--output", "/proc/nowhere/x.index", "--faintest", "4.0"]) == 2
    assert "cannot be written" in capsys.readouterr().err
