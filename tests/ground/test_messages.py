"""Tests of object tracks as CCSDS Tracking Data Messages (503.0-B-2), from artificial packets."""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ground import messages
from knightcube.errors import UsageError
from knightcube.gnc.first_orbit import FirstOrbit
from tests.support.packed_run import packed_run

START_NS = 1_767_225_600_000_000_000  # 2026-01-01T00:00:00Z
ARCSECOND = math.radians(1.0 / 3600.0)


UNPLACED = {"place": [math.nan] * 3, "velocity": [math.nan] * 3}
"""Values of a track packet if the camera's orbit is unknown."""


def sighting(time: float, number: int, ra: float, dec: float, **values: Any) -> tuple[float, dict[str, Any]]:
    """Return the track packet of a sighting at given angles (deg)."""
    a, d = math.radians(ra), math.radians(dec)
    direction = [math.cos(d) * math.cos(a), math.cos(d) * math.sin(a), math.sin(d)]
    known = {
        "measured_sigma": 10.0 * ARCSECOND,
        "magnitude": math.nan,
        "magnitude_sigma": math.nan,
        **UNPLACED,
    }
    found = {"number": number, "middle_ns": round(time * 1e9), "measured": direction, **known}
    return time, {**found, **values}


UNSEEN = {"measured": [math.nan] * 3}
LABEL = (0.0, {"utc_ns": START_NS})


def test_a_tracking_message_has_the_angles_of_every_sighting_by_object(tmp_path: Path) -> None:
    run = packed_run(
        run=[LABEL],
        track=[
            sighting(
                1.5, 2, 300.0, -20.0, magnitude=4.25, magnitude_sigma=0.1, measured_sigma=30.0 * ARCSECOND
            ),
            sighting(2.0, 1, 10.0, 45.0),
            sighting(2.5, 2, 0.0, 0.0, **UNSEEN),
            sighting(3.5, 2, 301.0, -21.0, magnitude_sigma=0.3),
        ],
    )
    path = tmp_path / "new" / "tracks.tdm"
    with pytest.raises(UsageError, match=r"tracks\.oem: the suffix \.oem is for the orbit beside the tracks"):
        messages.write_tracking_data(run, path.with_suffix(".oem"))
    assert messages.write_tracking_data(run, path) == [path]
    text = path.read_text(encoding="ascii")
    assert text.endswith("\n")
    lines = text.splitlines()
    assert (lines[0], lines[2]) == ("CCSDS_TDM_VERS = 2.0", "ORIGINATOR = KNIGHTCUBE")
    made = datetime.fromisoformat(f"{lines[1].removeprefix('CREATION_DATE = ')}+00:00")
    assert abs((datetime.now(UTC) - made).total_seconds()) < 3600.0
    assert [line for line in lines if line.startswith("PARTICIPANT_2")] == [
        "PARTICIPANT_2 = OBJECT-1",
        "PARTICIPANT_2 = OBJECT-2",
    ]
    second = lines[lines.index("PARTICIPANT_2 = OBJECT-2") - 10 :]
    assert "START_TIME = 2026-01-01T00:00:01.500000" in second
    assert "STOP_TIME = 2026-01-01T00:00:03.500000" in second
    assert second[second.index("DATA_START") :] == [
        "DATA_START",
        "ANGLE_1 = 2026-01-01T00:00:01.500000 300.00000000",
        "ANGLE_2 = 2026-01-01T00:00:01.500000 -20.00000000",
        "MAG = 2026-01-01T00:00:01.500000 4.250",
        "ANGLE_1 = 2026-01-01T00:00:03.500000 301.00000000",
        "ANGLE_2 = 2026-01-01T00:00:03.500000 -21.00000000",
        "DATA_STOP",
    ]
    assert "COMMENT Standard deviation of each angle on the sky 20.00 arcsec in the median," in text
    assert "COMMENT and 10.00 to 30.00 arcsec in all, including the attitude error." in text
    assert "COMMENT Standard deviation of MAG 0.200 in the median, 0.300 at most:" in text
    assert text.count("Standard deviation of MAG") == 1, "the first object has no magnitude"


def test_the_orbit_message_has_one_state_of_the_camera_for_each_frame(tmp_path: Path) -> None:
    """Two objects of one frame share one camera state. A sighting without a known orbit gives no state."""
    states = [([7e6 + k, -1e6, 2e6], [1e3, 7e3 - k, -5e2]) for k in range(3)]
    track = [
        sighting(1.0 + k, number, 10.0, 5.0, place=place, velocity=velocity, place_sigma=20.0 + k)
        for k, (place, velocity) in enumerate(states)
        for number in (1, 2)
    ]
    track.append(sighting(9.0, 1, 11.0, 5.0, place=[math.nan] * 3, velocity=[math.nan] * 3))
    path = tmp_path / "tracks.tdm"
    run = packed_run(run=[LABEL], track=track)
    assert messages.write_tracking_data(run, path) == [path, tmp_path / "tracks.oem"]
    text = (tmp_path / "tracks.oem").read_text(encoding="ascii")
    assert "STOP_TIME = 2026-01-01T00:00:03.000000" in text
    assert "standard deviation per axis 0.022 km or less" in text
    rows = [line.split() for line in text.splitlines() if line.startswith("2026")]
    assert [row[0] for row in rows] == [f"2026-01-01T00:00:0{k}.000000" for k in (1, 2, 3)]
    read = np.array([row[1:] for row in rows], dtype=float) * 1e3
    np.testing.assert_allclose(read, [[*place, *velocity] for place, velocity in states], atol=1e-5)
    reader = pytest.importorskip("ccsds_ndm.ndm_io").NdmIo()
    (segment,) = reader.from_path(tmp_path / "tracks.oem").body.segment
    assert [float(one.x.value) for one in segment.data.state_vector] == pytest.approx(read[:, 0] * 1e-3)


def test_the_attitudes_are_read_by_a_reader_of_other_authors(tmp_path: Path) -> None:
    turned = [[0.6, 0.0, 0.0, 0.8], [0.0, -0.6, 0.0, 0.8]]
    run = packed_run(
        run=[LABEL],
        navigation=[(0.0, {})],
        attitude=[
            (0.5, {"quaternion": [math.nan] * 4}),
            *((1.0 + k, {"quaternion": one, "angle_sigma": [0.01] * 3}) for k, one in enumerate(turned)),
        ],
    )
    path = tmp_path / "attitude.aem"
    assert messages.write_attitudes(run, path) == [path]
    text = path.read_text(encoding="ascii")
    assert "START_TIME = 2026-01-01T00:00:01.000000" in text
    assert "about a body axis 0.5730 deg" in text
    rows = [line.split()[1:] for line in text.splitlines() if line.startswith("2026")]
    np.testing.assert_allclose(np.array(rows, dtype=float), turned, atol=1e-9)
    reader = pytest.importorskip("ccsds_ndm.ndm_io").NdmIo()
    (segment,) = reader.from_path(path).body.segment
    read = [one.quaternion_state.quaternion for one in segment.data.attitude_state]
    found = [[float(getattr(one, name)) for name in ("q1", "q2", "q3", "qc")] for one in read]
    np.testing.assert_allclose(found, turned, atol=1e-9)


def test_a_testbed_has_no_attitudes_in_icrs(tmp_path: Path) -> None:
    run = packed_run(run=[LABEL], attitude=[(1.0, {"quaternion": [0.0, 0.0, 0.0, 1.0]})])
    with pytest.raises(UsageError, match="give the run of a satellite"):
        messages.write_attitudes(run, tmp_path / "attitude.aem")


def test_a_run_without_sightings_has_no_message(tmp_path: Path) -> None:
    for run in (
        packed_run(run=[LABEL]),
        packed_run(run=[LABEL], track=[sighting(1.0, 1, 0.0, 0.0, **UNSEEN)]),
    ):
        with pytest.raises(UsageError, match="no object was tracked"):
            messages.write_tracking_data(run, tmp_path / "tracks.tdm")
    with pytest.raises(UsageError, match="no object was tracked"):
        messages.orbits_of(packed_run(run=[LABEL]))


@pytest.mark.parametrize("labels", [[], [(0.0, {"utc_ns": 0})]])
def test_a_log_without_the_utc_of_the_flight_has_no_message(
    labels: list[tuple[float, dict[str, int]]], tmp_path: Path
) -> None:
    attitude = [(1.0, {"quaternion": [0.0, 0.0, 0.0, 1.0]})]
    track = [sighting(1.0, 1, 0.0, 0.0)]
    run = packed_run(run=labels, track=track, navigation=[(0.0, {})], attitude=attitude)
    writers: list[Callable[[], object]] = [
        lambda: messages.write_tracking_data(run, tmp_path / "a.tdm"),
        lambda: messages.write_attitudes(run, tmp_path / "a.aem"),
        lambda: messages.orbits_of(run),
    ]
    for write in writers:
        with pytest.raises(UsageError, match="no packet `run` with the UTC"):
            write()


def test_a_message_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    run = packed_run(run=[LABEL], track=[sighting(1.0, 1, 0.0, 0.0)])
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="the message cannot be written"):
        messages.write_tracking_data(run, tmp_path / "file" / "tracks.tdm")


@pytest.mark.parametrize(
    ("utc_ns", "text"),
    [
        (0, "1970-01-01T00:00:00.000000"),
        (START_NS + 1_999, "2026-01-01T00:00:00.000001"),
        (START_NS + 59_123_456_789, "2026-01-01T00:00:59.123456"),
    ],
)
def test_a_date_has_microseconds(utc_ns: int, text: str) -> None:
    assert messages.ccsds_date(utc_ns) == text


def test_too_few_sightings_with_a_position_give_a_reason_instead_of_an_orbit() -> None:
    track = [
        sighting(float(t), 7, 10.0 + t, 5.0, place=[7e6, 0.0, 0.0] if t else [math.nan] * 3) for t in range(3)
    ]
    (found,) = messages.orbits_of(packed_run(run=[LABEL], track=track))
    assert (found.number, found.sightings, found.span, found.orbit) == (7, 3, 2.0, None)
    assert found.reason.startswith("2 sightings with the satellite's position")


def both_forms(tmp_path: Path, write: Any) -> tuple[list[Any], list[Any]]:
    """Return the messages of the same data in text and in XML, as an independent program reads them."""
    reader = pytest.importorskip("ccsds_ndm.ndm_io").NdmIo()
    plain, xml = (write(tmp_path / name, as_xml) for name, as_xml in (("kvn", False), ("xml", True)))
    assert all(path.read_text(encoding="ascii").startswith("<?xml") for path in xml)
    return [reader.from_path(path) for path in plain], [reader.from_path(path) for path in xml]


def test_tracks_and_the_camera_s_orbit_in_xml_have_the_values_of_the_plain_form(tmp_path: Path) -> None:
    place, velocity = [6.9e6, 1e5, -2e5], [-100.0, 7500.0, 300.0]
    track = [
        sighting(1.0 + k, 1, 10.0 + k, 5.0, magnitude=4.0, place=place, velocity=velocity, place_sigma=20.0)
        for k in range(3)
    ]
    run = packed_run(run=[LABEL], track=track)
    plain, xml = both_forms(
        tmp_path, lambda folder, as_xml: messages.write_tracking_data(run, folder / "a.tdm", as_xml)
    )
    angles = []
    for tracks, orbit in (plain, xml):
        (segment,) = tracks.body.segment
        assert segment.metadata.participant_2 == "OBJECT-1"
        angles.append(
            [(str(one.epoch), one.angle_1, one.angle_2, one.mag) for one in segment.data.observation]
        )
        (segment,) = orbit.body.segment
        read = [one for one in segment.data.state_vector]
        assert [float(one.x_dot.value) for one in read] == [-0.1] * 3
        assert [float(one.z.value) for one in read] == [-200.0] * 3
    assert len(angles[0]) == 9
    assert repr(angles[0]) == repr(angles[1])


def test_attitudes_in_xml_have_the_values_of_the_plain_form(tmp_path: Path) -> None:
    attitude = [(1.0 + k, {"quaternion": [0.6, 0.0, 0.0, 0.8], "angle_sigma": [0.01] * 3}) for k in range(2)]
    run = packed_run(run=[LABEL], navigation=[(0.0, {})], attitude=attitude)
    for (message,) in both_forms(
        tmp_path, lambda folder, as_xml: messages.write_attitudes(run, folder / "a.aem", as_xml)
    ):
        (segment,) = message.body.segment
        assert segment.metadata.start_time == "2026-01-01T00:00:01.000000"
        read = [one.quaternion_state.quaternion for one in segment.data.attitude_state]
        assert [(float(one.q1), float(one.qc)) for one in read] == [(0.6, 0.8)] * 2


def test_an_orbit_in_xml_has_the_values_of_the_plain_form(tmp_path: Path) -> None:
    state = np.array([7.0e6, 1.0e5, 2.0e5, -10.0, 7.5e3, 20.0])
    covariance = np.diag([1e6] * 3 + [1.0] * 3)
    orbit = FirstOrbit(0.0, state, covariance, 5.0e5, (4.0e5, 6.0e5), True, 20.0, 18)
    found = [messages.ObjectOrbit(3, 12, 60.0, START_NS, orbit, "")]
    for (message,) in both_forms(
        tmp_path, lambda folder, as_xml: messages.write_orbit_messages(found, folder, as_xml)
    ):
        data = message.body.segment.data
        assert float(data.state_vector.y_dot.value) == 7.5
        assert data.state_vector.x.units.value == "km"
        assert float(data.covariance_matrix.cx_x.value) == 1.0
        assert data.covariance_matrix.cov_ref_frame == "ICRF"
