"""Tests of mean elements in the formats of CelesTrak and Space-Track, and of refused element sets."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.astro.earth.omm import read_elements
from knightcube.astro.earth.orbit_knowledge import OrbitError, TwoLineElements
from knightcube.errors import UsageError
from tests.support.orbit_elements import summed

INPUTS = Path(__file__).resolve().parents[5] / "shared/data/inputs"
LINES = (
    "1 25544U 98067A   26320.51782528  .00012182  00000-0  21606-3 0  2929",
    "2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.49125391563531",
)
OMM: dict[str, object] = {
    "OBJECT_NAME": "ISS (ZARYA)",
    "OBJECT_ID": "1998-067A",
    "EPOCH": "2026-11-16T12:25:40.104192",
    "MEAN_MOTION": 15.49125391,
    "ECCENTRICITY": 0.0006703,
    "INCLINATION": 51.6416,
    "RA_OF_ASC_NODE": 247.4627,
    "ARG_OF_PERICENTER": 130.536,
    "MEAN_ANOMALY": 325.0288,
    "EPHEMERIS_TYPE": 0,
    "CLASSIFICATION_TYPE": "U",
    "NORAD_CAT_ID": 25544,
    "ELEMENT_SET_NO": 292,
    "REV_AT_EPOCH": 56353,
    "BSTAR": 0.00021606,
    "MEAN_MOTION_DOT": 0.00012182,
    "MEAN_MOTION_DDOT": 0,
}
METADATA = {
    "CENTER_NAME": "EARTH",
    "REF_FRAME": "TEME",
    "TIME_SYSTEM": "UTC",
    "MEAN_ELEMENT_THEORY": "SGP4",
}


def with_columns(line: str, first: int, text: str) -> str:
    """Return a line of elements with `text` from the column `first` on, and with the right checksum."""
    return summed(line[: first - 1] + text + line[first - 1 + len(text) :])


def as_json(*messages: dict[str, object]) -> str:
    return json.dumps(list(messages))


def as_strings(*messages: dict[str, object]) -> str:
    """Return the JSON of Space-Track, in which all values are strings or null."""
    texts = {"COMMENT": "GENERATED VIA SPACE-TRACK.ORG API", **METADATA, "DECAY_DATE": None}
    return json.dumps([texts | {key: str(value) for key, value in each.items()} for each in messages])


def as_csv(*messages: dict[str, object]) -> str:
    file = io.StringIO()
    writer = csv.DictWriter(file, list(messages[0]))
    writer.writeheader()
    writer.writerows(messages)
    return file.getvalue()


def as_kvn(*messages: dict[str, object]) -> str:
    def lines(message: dict[str, object]) -> list[str]:
        head = [
            "CCSDS_OMM_VERS = 2.0",
            "COMMENT made = for a test",
            "CREATION_DATE = 2026-11-16T18:00:00",
            "",
        ]
        units = {"MEAN_MOTION": " [rev/day]", "INCLINATION": " [deg]"}
        both = {"OBJECT_NAME": message.get("OBJECT_NAME", ""), **METADATA, **message}
        return [*head, *(f"{key:20}= {value}{units.get(key, '')}" for key, value in both.items())]

    return "\r\n".join(line for message in messages for line in lines(message))


def as_xml(*messages: dict[str, object]) -> str:
    def omm(message: dict[str, object]) -> str:
        tags = "".join(f"<{key}>{value}</{key}>" for key, value in (METADATA | message).items())
        return (
            '<omm id="CCSDS_OMM_VERS" version="3.0"><header><ORIGINATOR/></header><body><segment>'
            f"<metadata/><data><meanElements>{tags}</meanElements></data></segment></body></omm>"
        )

    return '<?xml version="1.0" encoding="UTF-8"?>\n<ndm>' + "".join(map(omm, messages)) + "</ndm>"


FORMS = {"json": as_json, "strings": as_strings, "csv": as_csv, "kvn": as_kvn, "xml": as_xml}


def far(one: tuple[str, str], other: tuple[str, str], days: float = 1.0) -> float:
    """Return the distance (m) of two element sets' positions, some days after the epoch of the first set."""
    first, second = TwoLineElements(*one), TwoLineElements(*other)
    date = first.epoch + days
    return float(np.linalg.norm(first.at(date).position - second.at(date).position))


@pytest.mark.parametrize("form", FORMS)
def test_each_form_of_an_omm_gives_the_orbit_of_the_two_lines(form: str) -> None:
    other = OMM | {"OBJECT_NAME": "LEMUR, 2", "NORAD_CAT_ID": 100_001, "INCLINATION": 97.4}
    first, second = read_elements(FORMS[form](OMM, other))
    assert (first.name, first.number) == ("ISS (ZARYA)", 25544)
    assert far(first.lines, LINES) < 10.0
    assert (second.name, second.number, second.lines[0][2:7]) == ("LEMUR, 2", 100_001, "A0001")


def test_an_omm_with_a_number_that_two_lines_cannot_hold_is_read() -> None:
    [found] = read_elements(
        as_json(OMM | {"NORAD_CAT_ID": 799_500_123, "EPOCH": "2026-320T12:25:40.104192Z"})
    )
    assert (found.number, found.lines[0][2:7]) == (799_500_123, "00000")
    assert far(found.lines, LINES) < 10.0


@pytest.mark.parametrize(
    ("epoch", "written"),
    [
        ("2026-12-31T23:59:59.9999", "27001.00000000"),
        ("2024-12-31T23:59:59.9999", "25001.00000000"),
        ("2024-12-31T23:59:59.9990", "24366.99999999"),
    ],
)
def test_an_epoch_just_before_the_end_of_a_year_becomes_a_day_that_exists(epoch: str, written: str) -> None:
    [found] = read_elements(as_json(OMM | {"EPOCH": epoch}))
    assert found.lines[0][18:32] == written


@pytest.mark.parametrize("name", ["", "ISS (ZARYA)\n", "0 ISS (ZARYA)\r\n"])
def test_two_lines_are_read_with_and_without_a_name(name: str) -> None:
    found = read_elements(f"{name}{LINES[0]}\r\n{LINES[1]}\n\n{name}{LINES[0]}\n{LINES[1]}")
    assert [each.lines for each in found] == [LINES] * 2
    assert found[0].name == ("ISS (ZARYA)" if name else "")


@pytest.mark.parametrize(
    ("text", "number"), [("A0001", 100_001), ("J2931", 182_931), ("Z9999", 339_999), ("    5", 5)]
)
def test_alpha_5_numbers_are_read(text: str, number: int) -> None:
    first, second = (with_columns(line, 3, text) for line in LINES)
    assert read_elements(f"{first}\n{second}")[0].number == number
    assert far((first, second), LINES) == 0.0


def test_one_number_may_be_padded_by_blanks_and_by_zeros() -> None:
    TwoLineElements(with_columns(LINES[0], 3, "    5"), with_columns(LINES[1], 3, "00005"))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("field", "value", "complaint"),
    [
        ("INCLINATION", 190.6416, "INCLINATION 190.6416 must be from 0 to 180 deg"),
        ("ARG_OF_PERICENTER", -109.4, "ARG_OF_PERICENTER -109.4 must be from 0 to 360 deg"),
        ("MEAN_MOTION", 0.0, "MEAN_MOTION 0.0 must be from 0.01 to 17.5 rev/day"),
        ("ECCENTRICITY", 0.6703, "give a perigee within the Earth"),
        ("BSTAR", "", "the field BSTAR is missing"),
        ("MEAN_ANOMALY", "325,0", "MEAN_ANOMALY is '325,0', which is not a number"),
        ("NORAD_CAT_ID", -3, "NORAD_CAT_ID -3 must be from 0"),
        ("EPHEMERIS_TYPE", 4, "EPHEMERIS_TYPE is '4', but must be 0"),
        ("MEAN_ELEMENT_THEORY", "SGP4-XP", "MEAN_ELEMENT_THEORY is 'SGP4-XP', but must be SGP4"),
        ("EPOCH", "2026-02-30T00:00:00", "EPOCH is '2026-02-30T00:00:00', but must have the form"),
        ("EPOCH", "2025-366T00:00:00", "EPOCH is '2025-366T00:00:00', but must have the form"),
        ("EPOCH", "2056-12-31T23:00:00-05:00", "must be in the years 1957 to 2056"),
        ("EPOCH", "2126-02-20T00:00:00", "EPOCH '2126-02-20T00:00:00' must be in the years 1957 to 2056"),
    ],
)
def test_a_wrong_field_of_an_omm_is_named(form: str, field: str, value: object, complaint: str) -> None:
    with pytest.raises(UsageError, match=r"^OMM 2 \(") as caught:
        read_elements(FORMS[form](OMM | {field: OMM.get(field, "SGP4")}, OMM | {field: value}))
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["", "[]", "[3]", "{", "<ndm>", "<ndm/>", "CCSDS_OMM_VERS", "a,b\n1,2", "MEAN_MOTION = 3\nx", "ISS\nISS"],
)
def test_a_text_without_elements_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        read_elements(text)


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("tle-shifted", "line 2, column 17: must be blank"),
        ("tle-mismatch", "line 2, columns 3 to 7: satellite number 37820, but line 1 has 25544"),
        ("tle-incl190", "line 2, columns 9 to 16: inclination '190.6416' must be from 0 to 180 deg"),
        (
            "tle-argp-negative",
            "line 2, columns 35 to 42: argument of perigee '-109.355' must be from 0 to 360",
        ),
        ("tle-bstar-line1", "line 1, columns 54 to 61: B* '.00021' must have the form ' 21606-3'"),
    ],
)
@pytest.mark.skipif(not INPUTS.is_dir(), reason="the inputs of ../shared/data/inputs are missing")
def test_reported_invalid_element_sets_are_refused(name: str, complaint: str) -> None:
    with pytest.raises(UsageError) as caught:
        read_elements((INPUTS / f"{name}.txt").read_text(encoding="ascii"))
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    ("line", "column", "text", "complaint"),
    [
        (1, 9, "9", "line 1, column 9: must be blank"),
        (1, 8, "u", "line 1, column 8: classification 'u'"),
        (1, 3, "I0001", "line 1, columns 3 to 7: satellite number 'I0001'"),
        (1, 21, "366.5", "line 1, columns 21 to 32: the day of the year of the epoch, 366.51782528,"),
        (1, 34, " .0001218 ", "line 1, columns 34 to 43: derivative of the mean motion '.0001218'"),
        (1, 54, " 21606+3", "line 1, columns 54 to 61: B* '21606+3' must be from -10 to 10"),
        (1, 63, "4", "line 1, column 63: ephemeris type 4 must be 0"),
        (1, 65, "2a29", "line 1, columns 65 to 68: number of the element set '2a29'"),
        (
            2,
            18,
            "360.4627",
            "line 2, columns 18 to 25: right ascension of the node '360.4627' must be from 0",
        ),
        (2, 27, " 006703", "line 2, columns 27 to 33: eccentricity without its point '006703'"),
        (2, 27, "6006703", "line 2, columns 27 to 33 and 53 to 63: eccentricity 0.60067 and mean motion"),
        (2, 44, "999.0288", "line 2, columns 44 to 51: mean anomaly '999.0288' must be from 0 to 360 deg"),
        (2, 53, "18", "line 2, columns 53 to 63: mean motion '18.49125391' must be from 0.01 to 17.5"),
        (2, 53, "15,4", "line 2, columns 53 to 63: mean motion '15,49125391' must have the form"),
    ],
)
def test_a_wrong_column_of_two_lines_is_named(line: int, column: int, text: str, complaint: str) -> None:
    lines = [*LINES]
    lines[line - 1] = with_columns(lines[line - 1], column, text)
    with pytest.raises(UsageError) as caught:
        TwoLineElements(lines[0], lines[1])
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_wrong_checksum_and_a_lost_column_are_named() -> None:
    with pytest.raises(UsageError, match="line 2, column 69: checksum 5, the sum of its columns gives 1"):
        TwoLineElements(LINES[0], LINES[1][:-1] + "5")
    with pytest.raises(UsageError, match="line 1 of a two-line element set has 69 columns"):
        TwoLineElements(LINES[0][:16] + LINES[0][17:], LINES[1])


@given(st.integers(0, 1), st.integers(1, 68), st.text(st.characters(codec="ascii"), min_size=1, max_size=3))
def test_any_changed_columns_are_refused_by_line_or_give_a_finite_orbit(
    which: int, at: int, text: str
) -> None:
    lines = [*LINES]
    lines[which] = summed(lines[which][: at - 1] + text + lines[which][at - 1 + len(text) :])
    refusal = ""
    try:
        known = TwoLineElements(lines[0], lines[1])
        assert np.all(np.isfinite(known.at(known.epoch + 1.0).position))
    except OrbitError:
        pass
    except UsageError as error:
        refusal = str(error)
    assert not refusal or "line " in refusal or "these elements describe no orbit" in refusal


@given(
    st.sampled_from([*OMM, *METADATA]),
    st.one_of(
        st.none(), st.floats(), st.integers(), st.text(max_size=12), st.lists(st.integers(), max_size=2)
    ),
    st.sampled_from(["json", "strings", "csv"]),
)
def test_any_changed_field_of_an_omm_is_refused_by_name_or_read(field: str, value: object, form: str) -> None:
    refusal = ""
    try:
        [found] = read_elements(FORMS[form](OMM | {field: value}))
        TwoLineElements(*found.lines)
    except UsageError as error:
        refusal = str(error)
    assert not refusal or field in refusal or "perigee" in refusal


@given(
    st.sampled_from([*FORMS, "tle"]),
    st.integers(0, 10_000),
    st.integers(0, 12),
    st.text(st.characters(codec="utf-8"), max_size=8),
)
def test_any_damaged_text_of_elements_is_refused_in_one_line_or_read(
    form: str, at: int, length: int, text: str
) -> None:
    whole = "\n".join(LINES) if form == "tle" else FORMS[form](OMM, OMM)
    at %= len(whole)
    refusal = ""
    try:
        for found in read_elements(whole[:at] + text + whole[at + length :]):
            TwoLineElements(*found.lines)
    except UsageError as error:
        refusal = str(error)
    assert "\n" not in refusal


def test_the_uncertainty_covers_an_error_of_the_drag_term() -> None:
    """The uncertainty covers the error of elements with B* 0 for an orbit with B* 5e-4.

    The error is 226 km after 6 days and 5514 km after 30 days.
    """
    lines = (
        "1 99001U 26001A   26320.50000000  .00000000  00000-0  00000+0 0  9995",
        "2 99001  97.4640 337.4170 0011973 295.7805  64.3547 15.30000000000102",
    )
    true = with_columns(lines[0], 54, " 50000-3"), lines[1]
    for days, off in ((6.0, 226e3), (30.0, 5514e3)):
        known = TwoLineElements(*lines)
        assert far(lines, true, days) == pytest.approx(off, rel=0.01)
        assert off / 4.0 < known.at(known.epoch + days).sigma < off
