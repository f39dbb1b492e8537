"""Tests of the commands that print reports, exports and initial orbits of a run."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.app.cli import to_json
from ground import messages
from ground.commands import runs
from ground.messages import ObjectOrbit, write_orbit_messages
from ground.report import summarise
from ground.telemetry import read_run
from knightcube.errors import UsageError
from knightcube.gnc.first_orbit import FirstOrbit
from tests.ground.commands.in_process import command
from tests.ground.report.synthetic import Recipe, make_run

UTC_NS = 1_767_225_600_250_000_000  # 2026-01-01T00:00:00.25Z


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a short run."""
    return make_run(tmp_path_factory.mktemp("run") / "run-1", Recipe(duration=2.0, planned=2.0, rate_hz=10.0))


def test_a_report_is_printed_as_text_or_json_and_pictures_are_drawn_when_wanted(
    flown: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    drawn: list[Path] = []

    def draw(_: Any, folder: Path) -> list[Path]:
        drawn.append(folder)
        return [folder / "a.png"]

    monkeypatch.setattr("ground.commands.runs.reporting.draw", draw)
    text = command("report", flown, "--no-figures")
    assert (text.returncode, drawn) == (0, [])
    assert text.stdout.startswith(f"Run {flown}: 2.0 s\n")
    facts = command("report", flown, "--json")
    assert facts.stdout == to_json(summarise(read_run(flown)))
    assert drawn == []
    pictures = command("report", flown)
    assert drawn == [flown / "figures"]
    assert pictures.stdout.endswith(f"\npictures:\n  {flown / 'figures' / 'a.png'}\n")
    silent = command("report", flown, "--json", "--figures", tmp_path)
    assert drawn[-1] == tmp_path
    assert json.loads(silent.stdout)


def test_pictures_that_cannot_be_drawn_fail_only_if_their_folder_was_given(
    flown: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def draw(_: Any, folder: Path) -> list[Path]:
        raise UsageError("no matplotlib")

    monkeypatch.setattr("ground.commands.runs.reporting.draw", draw)
    for words, status in (((), 0), (("--figures", tmp_path), 2)):
        done = command("report", flown, *words)
        assert (done.returncode, done.stderr) == (status, "knightcube: no matplotlib\n")


def test_two_runs_are_compared_and_drawn_into_a_given_folder(
    flown: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    drawn: list[Path] = []

    def draw(_first: Any, _second: Any, folder: Path) -> Path:
        drawn.append(folder)
        return folder / "both.png"

    monkeypatch.setattr("ground.commands.runs.reporting.draw_both", draw)
    assert command("report", flown, flown, "--no-figures", "--figures", tmp_path).returncode == 0
    assert command("report", flown, flown).returncode == 0
    assert drawn == []
    text = command("report", flown, flown, "--figures", tmp_path)
    assert text.stdout.endswith(f"\npicture:\n  {tmp_path / 'both.png'}\n")
    facts = command("report", flown, flown, "--json", "--figures", tmp_path)
    assert set(json.loads(facts.stdout)) >= {"figures", "events", "configuration"}
    assert drawn == [tmp_path] * 2


def test_an_export_of_a_damaged_log_states_the_gaps(flown: Path, tmp_path: Path) -> None:
    whole = command("export", flown, "--out", tmp_path / "whole")
    assert whole.stderr == ""
    data = bytearray((flown / "flight-0001.ccsds").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "run").mkdir()
    (tmp_path / "run/flight-0001.ccsds").write_bytes(data)
    done = command("export", tmp_path / "run", "--out", tmp_path / "csv")
    assert done.returncode == 0
    assert "the exported files have gaps: in the flight log 1 packets are missing, " in done.stderr


def test_an_export_prints_its_files(flown: Path, tmp_path: Path) -> None:
    done = command("export", flown, "--out", tmp_path / "csv")
    files = sorted((tmp_path / "csv").iterdir())
    assert sorted(done.stdout.split()) == [str(file) for file in files]
    facts = json.loads(
        command("export", flown, "--format", "sqlite", "--out", tmp_path / "a.db", "--json").stdout
    )
    assert facts == {"files": [str(tmp_path / "a.db")]}
    missing = command("export", flown, "--tdm", tmp_path / "t.tdm")
    assert missing.returncode == 2, "no object was tracked"


def orbit(lasts: bool = True) -> ObjectOrbit:
    """Return an orbit of an object in which no two values are equal."""
    state = np.array([7e6, -1e6, 2e6, 1e3, 7e3, -5e2])
    root = np.arange(36.0).reshape(6, 6) / 10.0 + np.diag([30.0, 20.0, 10.0, 3.0, 2.0, 1.0])
    found = FirstOrbit(5.0, state, root @ root.T, 3e5, (2.9e5, 3.2e5), lasts, 12.5, 14)
    return ObjectOrbit(4, 10, 61.4, UTC_NS, found, "")


NONE = ObjectOrbit(9, 3, 8.0, None, None, "too short")


def test_orbits_are_printed_with_their_uncertainty(monkeypatch: pytest.MonkeyPatch, flown: Path) -> None:
    monkeypatch.setattr(runs, "orbits_of", lambda _: [orbit(), NONE])
    done = command("orbit", flown)
    assert done.returncode == 1, "one object has no orbit"
    text = done.stdout
    assert text.startswith("object 4: 10 sightings in 61 s\n")
    assert text.endswith("object 9: 3 sightings in 8 s\n  no orbit: too short\n")
    covariance = orbit().orbit.covariance  # type: ignore[union-attr]  # there is one
    place, speed = (math.sqrt(np.trace(covariance[part, part])) for part in (slice(3), slice(3, 6)))
    numbers = ("7000.000", "-1000.000", "2000.000", "300.0", "290.0", "320.0", "chi-square 12 with 14")
    for number in (*numbers, f"+- {1e-3 * place:.3g} km", f"+- {1e-3 * speed:.3g} km/s"):
        assert number in text, number
    assert "escapes" not in text
    assert "escapes" in runs._orbit_text(orbit(lasts=False))
    monkeypatch.setattr(runs, "orbits_of", lambda _: [orbit()])
    facts = json.loads(command("orbit", flown, "--json").stdout)
    (item,) = facts["objects"]
    assert facts["files"] == []
    assert (item["object"], item["sightings"], item["span_s"]) == (4, 10, 61.4)
    found = item["orbit"]
    assert found["utc"].startswith("2026-01-01T00:00:00.25")
    assert found["position_m"] + found["velocity_m_s"] == [7e6, -1e6, 2e6, 1e3, 7e3, -5e2]
    np.testing.assert_allclose(found["covariance"], covariance, rtol=1e-11)
    assert (found["distance_m"], found["distance_95_m"]) == (3e5, [2.9e5, 3.2e5])
    assert (found["lasts"], found["chi_square"], found["degrees"]) == (True, 12.5, 14)
    assert runs._orbit_facts(NONE) == {
        "object": 9,
        "sightings": 3,
        "span_s": 8.0,
        "orbit": None,
        "reason": "too short",
    }


def test_an_orbit_message_has_the_state_and_the_covariance_in_km(tmp_path: Path) -> None:
    (path,) = write_orbit_messages([NONE, orbit()], tmp_path / "new")
    assert path == tmp_path / "new" / "object-4.opm"
    lines = path.read_text(encoding="ascii").splitlines()
    made = orbit().orbit
    assert made is not None
    assert lines[0] == "CCSDS_OPM_VERS = 3.0"
    assert "10 sightings in 61 s" in lines[1]
    assert "300.0 km" in lines[2]
    assert "290.0 to 320.0 km" in lines[2]
    assert "EPOCH = 2026-01-01T00:00:00.250000" in lines
    begin = lines.index("X = 7000.000000000 [km]")
    assert lines[begin : begin + 6] == [
        "X = 7000.000000000 [km]",
        "Y = -1000.000000000 [km]",
        "Z = 2000.000000000 [km]",
        "X_DOT = 1.000000000 [km/s]",
        "Y_DOT = 7.000000000 [km/s]",
        "Z_DOT = -0.500000000 [km/s]",
    ]
    axes = ["X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT"]
    expected = []
    for row in range(6):
        for column in range(row + 1):
            rates = sum(axes[k].endswith("_DOT") for k in (row, column))
            unit = {0: "km**2", 1: "km**2/s", 2: "km**2/s**2"}[rates]
            value = made.covariance[row, column] / 1e6
            expected.append(f"C{axes[row]}_{axes[column]} = {value:.9e} [{unit}]")
    assert lines[-21:] == expected
    assert orbit().date.microsecond == 250_000
    with pytest.raises(UsageError, match="cannot be written"):
        write_orbit_messages([orbit()], path)


@pytest.mark.parametrize(
    ("utc_ns", "text"),
    [
        (UTC_NS, "2026-01-01T00:00:00.250000"),
        (1999, "1970-01-01T00:00:00.000001"),
        (0, "1970-01-01T00:00:00.000000"),
    ],
)
def test_dates_have_microseconds(utc_ns: int, text: str) -> None:
    assert messages.ccsds_date(utc_ns) == text


def test_sightings_without_a_position_give_no_orbit() -> None:
    track = np.zeros(
        3,
        dtype=[
            ("number", "u4"),
            ("middle_ns", "i8"),
            ("measured", "f8", 3),
            ("place", "f8", 3),
            ("relative", "u1"),
        ],
    )
    track["number"] = 2
    track["middle_ns"] = [10**9, 3 * 10**9, 8 * 10**9]
    track["measured"][2] = math.nan
    labels = np.ones(1, dtype=[("utc_ns", "i8")])
    run = cast(Any, {"track": track, "run": labels})
    (found,) = messages.orbits_of(run)
    assert (found.number, found.sightings, found.span, found.orbit) == (2, 2, 2.0, None)
    assert found.reason.startswith("2 sightings")
    empty = SimpleNamespace(folder="here")
    with pytest.raises(UsageError, match="no object"):
        raise messages._no_object(cast(Any, empty))
