"""Tests that objects are detected, tracked and reported in flight, and that an empty sky gives no track."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from ground.messages import write_tracking_data
from ground.report.figures import objects_figure
from ground.report.orbit import objects
from ground.report.panels import RunSignals
from ground.report.summary import summarise
from ground.report.text import format_report
from ground.telemetry import Run
from knightcube.errors import UsageError
from tests.scenario.object_flights import (
    _BRIGHTNESS,
    _LINES,
    _PIXEL,
    _place,
    flight_with_objects,
    two_objects,
)
from tests.support.flights import demo_config, event_names, fly


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return a flight with two objects in the field of view."""
    return flight_with_objects(tmp_path_factory.mktemp("tracked"), two_objects())


def test_two_objects_are_found_and_tracked_to_a_fraction_of_a_pixel(tracked: Run) -> None:
    run = tracked
    assert event_names(run).count("object-found") >= 1
    tracks = run["track"]
    assert set(tracks["number"].tolist()) == {1, 2}
    for number in (1, 2):
        track = tracks[tracks["number"] == number]
        true = [_place(line, track["middle_ns"] * 1e-9) for line in _LINES]
        away = [np.linalg.norm(track["direction"] - place, axis=1) for place in true]
        own = int(np.argmin([one[-1] for one in away]))
        assert away[own].max() < 0.3 * _PIXEL
        rate = np.degrees(np.linalg.norm(track["rate"][-1]))
        assert abs(rate - _LINES[own].rate_deg) < 0.01
        assert abs(track["magnitude"][-1] - _BRIGHTNESS[own]) < 0.3
        assert track["seen"].all()


def test_the_report_lists_and_draws_them(tracked: Run) -> None:
    rows = objects(tracked)
    assert len(rows) == 2
    for row, magnitude, line in zip(
        sorted(rows, key=lambda row: row["magnitude"]), _BRIGHTNESS, _LINES, strict=True
    ):
        assert row["magnitude"] == pytest.approx(magnitude, abs=0.4)
        assert np.degrees(row["rate_most_rad_s"]) == pytest.approx(line.rate_deg, rel=0.05)
        assert 3 < row["seen"] <= row["frames"]
    assert "Objects among the stars" in format_report(summarise(tracked))
    assert objects_figure(RunSignals(tracked)) is not None


def test_a_sky_without_objects_has_no_track(tmp_path: Path) -> None:
    run = flight_with_objects(tmp_path, ())
    assert len(run["sightings"]) >= 8
    assert not len(run["track"])
    assert "object-found" not in event_names(run)


def test_the_measured_track_is_read_back_from_its_message(tracked: Run, tmp_path: Path) -> None:
    """An independent reader of the tracking data message finds the objects' directions at their times."""
    (path,) = write_tracking_data(tracked, tmp_path / "track.tdm")
    segments = path.read_text(encoding="ascii").split("META_START")
    assert len(segments) == 3
    assert "CCSDS_TDM_VERS = 2.0" in segments[0]
    zero = datetime.fromtimestamp(int(tracked["run"]["utc_ns"][-1]) * 1e-9, UTC).replace(tzinfo=None)
    found = [_nearest_line(segment, zero) for segment in segments[1:]]
    assert sorted(found) == [0, 1]


def _nearest_line(segment: str, zero: datetime) -> int:
    """Return the index of the object to which all data of a segment of the message belong."""
    words = [row.split(" = ") for row in segment.splitlines() if " = " in row]
    header = {word[0]: word[1] for word in words if len(word[1].split()) == 1}
    assert (header["ANGLE_TYPE"], header["REFERENCE_FRAME"], header["TIME_SYSTEM"]) == (
        "RADEC",
        "ICRF",
        "UTC",
    )
    data = [(key, *value.split()) for key, value in words if len(value.split()) == 2]
    angles = {key: [float(value) for name, _, value in data if name == key] for key in ("ANGLE_1", "ANGLE_2")}
    times = [(datetime.fromisoformat(at) - zero).total_seconds() for name, at, _ in data if name == "ANGLE_1"]
    right, up = np.radians(angles["ANGLE_1"]), np.radians(angles["ANGLE_2"])
    seen = np.stack([np.cos(up) * np.cos(right), np.cos(up) * np.sin(right), np.sin(up)], axis=1)
    assert len(seen) >= 5
    away = [np.linalg.norm(seen - _place(line, np.array(times)), axis=1).max() for line in _LINES]
    own = int(np.argmin(away))
    assert away[own] < 0.5 * _PIXEL
    magnitudes = [float(value) for name, _, value in data if name == "MAG"]
    np.testing.assert_allclose(magnitudes, _BRIGHTNESS[own], atol=0.3)
    return own


def test_the_message_is_read_by_a_reader_of_other_authors(tracked: Run, tmp_path: Path) -> None:
    """The message is valid for `ccsds-ndm`, which builds its objects from the schema of the standard."""
    reader = pytest.importorskip("ccsds_ndm.ndm_io").NdmIo()
    (path,) = write_tracking_data(tracked, tmp_path / "track.tdm")
    segments = reader.from_path(path).body.segment
    tracks = tracked["track"]
    measured = tracks[np.all(np.isfinite(tracks["measured"]), axis=1)]
    assert len(segments) == 2
    for number, segment in enumerate(segments, 1):
        own = measured[measured["number"] == number]
        read = {
            name: [getattr(one, name).value for one in segment.data.observation if getattr(one, name)]
            for name in ("angle_1", "angle_2")
        }
        right, up = (np.radians(np.array(read[name], dtype=float)) for name in ("angle_1", "angle_2"))
        seen = np.stack([np.cos(up) * np.cos(right), np.cos(up) * np.sin(right), np.sin(up)], axis=1)
        np.testing.assert_allclose(seen, own["measured"], atol=1e-9)
        magnitudes = [float(one.mag) for one in segment.data.observation if one.mag is not None]
        np.testing.assert_allclose(magnitudes, own["magnitude"], atol=6e-4)
        told = " ".join(segment.metadata.comment)
        assert "Standard deviation of MAG" in told


def test_a_run_without_a_track_has_no_message(tmp_path: Path) -> None:
    run = fly(demo_config(1.0, camera=False), tmp_path)
    with pytest.raises(UsageError, match="no object was tracked"):
        write_tracking_data(run, tmp_path / "track.tdm")
