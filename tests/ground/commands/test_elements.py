"""Tests of the commands `elements`, `passes` and `day`; `knightcube check` accepts the new elements."""

from __future__ import annotations

import argparse
import csv
import json
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from flight.app.cli import main
from flight.link.process import directives
from flight.link.process.directives import Scheduled
from flight.link.telemetry.definitions import FIX
from flight.link.telemetry.log import FlightLog
from flight.link.telemetry.packets import Packer
from ground.commands import elements, satellite
from ground.telemetry import read_run
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from knightcube.astro.earth.orientation import celestial_to_terrestrial
from sim_hal.worlds.orbit import julian_date
from tests.ground.commands.in_process import command
from tests.manual_clock import ManualClock
from tests.support.orbit_elements import POLAR_ORBIT

ORBIT = tuple(
    ["--altitude", "500", "--inclination", "97.4", "--epoch", "2026-03-20T12:00:00", "--local-time", "10.5"]
)


def test_the_elements_of_an_orbit_are_those_of_the_shipped_configuration() -> None:
    given, configured = command("elements", *ORBIT), command("elements", "--config", "orbit_3u")
    assert (given.returncode, given.stderr) == (0, "")
    assert given.stdout == configured.stdout
    assert given.stdout.startswith("elements: ")
    facts = json.loads(command("elements", *ORBIT, "--json").stdout)
    assert all(f"  - '{line}'\n" in given.stdout for line in facts["elements"])
    assert facts["rms_m"] < 500.0
    assert facts["largest_m"] == max(facts["residuals_m"]) < 1e3
    assert (facts["positions"], facts["span_s"]) == (145, pytest.approx(86_400.0))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("--epoch", "2070-03-20T12:00:00"), "two digits: give times from 1957 to 2056"),
        (("--epoch", "1900-03-20T12:00:00"), "two digits: give times from 1957 to 2056"),
        (("--local-time", "30"), "`local_time` is 30.0: must be 0 to 24"),
    ],
)
def test_an_orbit_that_two_lines_cannot_state_is_refused(change: tuple[str, str], reason: str) -> None:
    done = command("elements", *ORBIT, *change)
    assert (done.returncode, done.stdout) == (2, "")
    assert reason in done.stderr


@pytest.mark.parametrize("velocity", [False, True])
def test_elements_are_fitted_to_noisy_fixes(velocity: bool, tmp_path: Path) -> None:
    lines = json.loads(command("elements", *ORBIT, "--json").stdout)["elements"]
    known, rng, start = (
        TwoLineElements(*lines),
        np.random.default_rng(1),
        datetime(2026, 3, 20, 12, tzinfo=UTC),
    )
    path = tmp_path / "fixes.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["utc", "x", "y", "z", "satellites", *(["vx", "vy", "vz"] if velocity else [])])
        for minute in range(0, 720, 5):
            utc = (start + timedelta(minutes=minute)).replace(tzinfo=None).isoformat()
            date = julian_date(f"{utc}Z")
            state, to_ground = known.at(date), celestial_to_terrestrial(date)
            ground = to_ground @ state.position
            speed = to_ground @ state.velocity - np.cross([0.0, 0.0, 7.292115e-5], ground)
            noisy = ground + 10.0 * rng.standard_normal(3)
            writer.writerow([utc, *noisy, 9, *(speed + 0.1 * rng.standard_normal(3) if velocity else [])])
    facts = json.loads(command("elements", "--fixes", path, "--json").stdout)
    assert facts["rejected"] == 0
    assert facts["growth_m_per_day"] < 20.0
    shown = command("elements", "--fixes", path).stdout
    assert "fitted to 144 positions over 11.9 h, 0.0" in shown
    assert " km per day along the track]" in shown
    assert facts["rms_m"] == pytest.approx(10.0 * 3**0.5, rel=0.3)
    found = TwoLineElements(*facts["elements"])
    for hours in (0.0, 12.0, 24.0):
        date = julian_date("2026-03-20T12:00:00Z") + hours / 24.0
        assert np.linalg.norm(found.at(date).position - known.at(date).position) < 200.0


def test_repeated_and_late_fixes_of_a_flight_log_are_put_in_order(tmp_path: Path) -> None:
    packer, log = Packer(), FlightLog(tmp_path, "flight", clock=ManualClock(0), sync_period_ns=None)
    blank = {field.name: [0.0] * field.count if field.count > 1 else 0 for field in FIX.fields}
    for at, seconds in enumerate((10, 20, 20, 0, 30)):
        utc_ns = (1_774_000_000 + seconds) * 1_000_000_000
        fields = {**blank, "utc_ns": utc_ns, "position": [7e6, float(seconds), 0.0]}
        log.write(packer.pack(FIX, at * 10_000_000_000, **fields))
    log.close()
    found = elements.read_fixes(tmp_path)
    assert 86_400.0 * (found.dates - found.dates[0]) == pytest.approx([0.0, 10.0, 20.0, 30.0], abs=1e-3)


@pytest.mark.slow
def test_elements_are_fitted_to_the_fixes_in_a_flight_log(tmp_path: Path) -> None:
    """Elements are fitted to a flight log with one GPS fix every ten seconds."""
    out, path = tmp_path / "run", tmp_path / "mine.yaml"
    path.write_text("extends: orbit_3u\ncamera: none\nwide_cameras: []\n", encoding="utf-8")
    assert command("run", path, "--duration", "70", "--out", out).returncode == 0
    facts = json.loads(command("elements", "--fixes", out, "--json").stdout)
    assert 4 <= facts["positions"] <= 7
    assert facts["rejected"] == 0
    assert facts["rms_m"] < 20.0, "the columns round angles to 12 m, the receiver errs by 4 m"
    truth = read_run(out)["orbit_truth"][-1]
    off = TwoLineElements(*facts["elements"]).at(float(truth["utc"])).position - truth["position"]
    assert np.linalg.norm(off) < 50.0
    assert facts["growth_m_per_day"] > 500.0, "a minute does not determine an orbit for a day"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--altitude", "500", "--inclination", "97.4"), "--altitude needs --epoch"),
        (("--altitude", "50", *ORBIT[2:]), "--altitude 50: give a number from 200 to 2000 km"),
        (
            (*ORBIT, "--eccentricity", "0.08"),
            "the perigee is at -50 km, below 150 km: for a mean altitude of 500 km give an",
        ),
        ((*ORBIT[:5], "noon"), "--epoch: 'noon': give a time such as"),
        (("--config", "step_demo"), "this needs the configuration of a satellite in orbit"),
        (("--config", "orbit", "--anomaly", "3"), "--anomaly: only with --altitude"),
        (("--fixes", "absent.csv"), "absent.csv: cannot be read"),
        (("--read", "absent.json"), "absent.json: cannot be read"),
        (("--config", "orbit_3u", "--satellite", "5"), "--satellite: only with --read"),
    ],
)
def test_wrong_use_is_reported_in_one_line(words: tuple[str, ...], complaint: str) -> None:
    done = command("elements", *words)
    assert done.returncode == 2
    assert complaint in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("utc,x,y\n", "the column z is missing: give utc, x, y, z and, if known, vx, vy, vz"),
        ("utc,x,y,z\n2026-03-20T12:00:00,1,2,far\n", "fixes.csv:2: column z: 'far' is not a number"),
        ("utc,x,y,z\nnoon,1,2,3\n", "fixes.csv:2: column utc: 'noon': give a time"),
        (
            "utc,x,y,z\n2026-03-20T12:00:00,7e6,0,0\n",
            "fixes.csv: elements need at least 4 positions; given: 1",
        ),
        ("utc,x,y,z\n", "elements need at least 4 positions; given: 0"),
    ],
)
def test_a_wrong_file_is_reported_with_its_line(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "fixes.csv"
    path.write_text(text, encoding="utf-8")
    done = command("elements", "--fixes", path)
    assert (done.returncode, complaint in done.stderr) == (2, True), done.stderr


def test_an_omm_is_read_into_a_configuration(tmp_path: Path) -> None:
    known = {
        **{"OBJECT_NAME": "MINE", "OBJECT_ID": "2026-001A", "EPOCH": "2026-03-20T12:00:00.5", "BSTAR": 3e-4},
        **{"MEAN_MOTION": 15.3, "ECCENTRICITY": 0.001, "INCLINATION": 97.464, "RA_OF_ASC_NODE": 337.4},
        **{"ARG_OF_PERICENTER": 295.8, "MEAN_ANOMALY": 64.4, "NORAD_CAT_ID": 123_456},
    }
    path = tmp_path / "gp.json"
    path.write_text(
        json.dumps([known, known | {"NORAD_CAT_ID": 5, "OBJECT_NAME": "OTHER"}]), encoding="utf-8"
    )
    several = command("elements", "--read", path)
    assert several.returncode == 2
    assert (
        "2 of 2 element sets match: give one satellite by --satellite: 123456 MINE, 5 OTHER" in several.stderr
    )
    absent = command("elements", "--read", path, "--satellite", "7")
    assert (absent.returncode, "0 of 2 element sets match" in absent.stderr) == (2, True)
    made = command("elements", "--read", path, "--satellite", "123456")
    assert (made.returncode, made.stderr) == (0, "")
    assert made.stdout.startswith(
        "elements:  # [read from gp.json: 123456 MINE]\n  - '1 C3456U 26001A   26079.5000"
    )
    facts = json.loads(command("elements", "--read", path, "--satellite", "123456", "--json").stdout)
    assert all(f"  - '{line}'\n" in made.stdout for line in facts["elements"])
    path.write_text(json.dumps(known | {"INCLINATION": 200}), encoding="utf-8")
    wrong = command("elements", "--read", path)
    assert "gp.json: OMM 1 (MINE): INCLINATION 200 must be from 0 to 180 deg" in wrong.stderr
    assert (wrong.returncode, wrong.stderr.count("\n")) == (2, 1)


def test_check_refuses_elements_that_do_not_fit_and_accepts_those_that_are_made(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    orbit = "simulation: {free_body: {orbit: {altitude: 420.0e3, inclination_deg: 51.6}}}\n"
    path.write_text(f"extends: orbit_3u\nduration: 1.0\n{orbit}", encoding="utf-8")
    done = command("check", path)
    assert done.returncode == 2
    assert "orbit.yaml:" in done.stderr
    assert "`elements` do not fit the first revolution of `simulation.free_body.orbit`: " in done.stderr
    assert " deg instead of 51.58 deg (tolerance 0.25 deg), mean semi-major axis " in done.stderr
    assert "(tolerance 100 km): `knightcube elements --config FILE` makes" in done.stderr
    made = command("elements", "--config", path)
    assert made.returncode == 0, made.stderr
    path.write_text(f"{path.read_text(encoding='utf-8')}{made.stdout}", encoding="utf-8")
    done = command("check", path)
    assert done.returncode == 0, done.stdout + done.stderr


def test_check_refuses_elements_that_do_not_fit_the_orbit_of_a_cage(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: cage\nsimulation: {cage: {orbit: {inclination_deg: 96.9}}}\n", encoding="utf-8")
    done = command("check", path)
    assert done.returncode == 2
    assert "`cage.elements` do not fit the first revolution of `simulation.cage.orbit`: mean " in done.stderr


def test_check_refuses_damaged_elements_with_their_place(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: orbit_3u\nelements: ['1 99999U', '2 99999']\n", encoding="utf-8")
    done = command("check", path)
    assert done.returncode == 2
    assert f"{path}:2: `elements` are not valid two-line elements: '1 99999U': line 1" in done.stderr


def test_check_refuses_a_target_if_the_position_is_never_known(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: orbit_3u\ngps: none\nelements: null\n", encoding="utf-8")
    done = command("check", path)
    assert done.returncode == 2
    assert (
        "`targets[0].point` is nadir: pointing needs the satellite's position: add `gps`, or `elements`"
        in done.stderr
    )


FROM_NOON = ("orbit_3u", "--from", "2026-03-20T12:00:00")
BERLIN = ("--station", "Berlin,52.5,13.4")


def test_the_table_and_the_object_have_the_same_passes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["passes", *FROM_NOON, *BERLIN]) == 0
    rows = capsys.readouterr().out.splitlines()[1:-1]
    assert main(["passes", *FROM_NOON, *BERLIN, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["passes"]
    rises = [datetime.fromisoformat(one["rise_utc"]).strftime("%Y-%m-%d %H:%M:%S") for one in found]
    assert [" ".join(row.split()[1:3]) for row in rows] == rises
    assert len(rises) >= 3


def test_the_schedule_consists_of_commands_that_can_be_sent(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["passes", *FROM_NOON, *BERLIN, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["passes"]
    assert main(["passes", *FROM_NOON, *BERLIN, "--schedule", "--lead", "90"]) == 0
    typed = capsys.readouterr().out.splitlines()
    parser = argparse.ArgumentParser()
    satellite.configure_command(parser)
    sent = []
    for line in typed:
        options = satellite._with_scheduled(parser.parse_args(["--to", "socket", *line.split()]))
        sent.append(directives.unpack(satellite.packet_of(options)))
    assert len(sent) == 2 * len(found)
    for one, (begin, end) in zip(found, zip(sent[::2], sent[1::2], strict=True), strict=True):
        assert isinstance(begin, Scheduled)
        assert isinstance(end, Scheduled)
        rise = datetime.fromisoformat(one["rise_utc"]).replace(tzinfo=None)
        assert abs(datetime.fromisoformat(begin.at) - (rise - timedelta(seconds=90))) < timedelta(seconds=1)
        assert begin.words.startswith("point ground 52.5deg ")
        assert end.words == "point nadir"


def test_elements_may_be_in_a_separate_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "elements.txt"
    file.write_text("SATELLITE\n" + "\n".join(POLAR_ORBIT) + "\n")
    assert main(["passes", str(file), "--from", "2026-03-20T12:00:00", *BERLIN]) == 0
    assert "Berlin" in capsys.readouterr().out


def test_old_elements_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["passes", "orbit_3u", "--from", "2026-04-10T12:00:00", *BERLIN]) == 0
    assert "the elements are old" in capsys.readouterr().err


def test_commands_of_overlapping_passes_are_in_order_of_time(capsys: pytest.CaptureFixture[str]) -> None:
    tromso = ("--station", "Tromso,69.66,18.94,130,10")
    assert main(["passes", *FROM_NOON, *BERLIN, *tromso, "--days", "2", "--schedule"]) == 0
    shown = capsys.readouterr()
    times = [line.split()[1] for line in shown.out.splitlines()]
    assert times == sorted(times)
    assert len(times) == len(set(times))
    assert f"{len(times)} commands, but the satellite stores 32" in shown.err
    assert main(["passes", *FROM_NOON, *BERLIN, *tromso, "--schedule", "--json"]) == 0
    listed = [line for one in json.loads(capsys.readouterr().out)["passes"] for line in one["schedule"]]
    assert listed
    assert [line.split()[1] for line in listed] == times[: len(listed)]


def test_a_command_of_a_pass_in_progress_is_due_at_the_start(capsys: pytest.CaptureFixture[str]) -> None:
    begin = "2026-03-20T21:57:00"
    assert main(["passes", "orbit_3u", "--from", begin, *BERLIN, "--days", "0.01", "--schedule"]) == 0
    first, *_ = capsys.readouterr().out.splitlines()
    assert first == f"schedule {begin} point ground 52.5 13.4"


def test_the_commands_of_a_prediction_from_now_on_can_still_be_sent(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Clock(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> Clock:
            return cls(2026, 3, 20, 21, 57, tzinfo=tz)

    monkeypatch.setattr(elements, "datetime", Clock)
    assert main(["passes", "orbit_3u", *BERLIN, "--days", "0.01", "--schedule"]) == 0
    first, *_ = capsys.readouterr().out.splitlines()
    assert first == "schedule 2026-03-20T21:58:00 point ground 52.5 13.4"


def test_a_station_that_never_sees_the_satellite_has_no_pass(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["passes", *FROM_NOON, "--station", "Berlin,52.5,13.4,0,89.9", "--days", "0.1"]) == 1
    assert capsys.readouterr().out == "no pass\n"


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (FROM_NOON, "give a ground station"),
        ((*FROM_NOON, *BERLIN, *BERLIN), "two stations are called 'Berlin'"),
        ((*FROM_NOON, *BERLIN, "--days", "31"), "--days 31: must be at most 30"),
        (("step_demo", *BERLIN), "this needs the configuration of a satellite"),
        ((*FROM_NOON, *BERLIN, "--schedule", "--lead", "-500"), "--lead -500: must be 0 s or more"),
        (("orbit_3u", "--from", "2026-12-20T12:00:00", *BERLIN), "the elements of 2026-03-20 are too old"),
        (
            ("orbit_3u", "--from", "2026-05-20T12:00:00", *BERLIN, "--schedule"),
            "which exceeds --lead 120: give newer elements",
        ),
    ],
)
def test_a_wrong_use_is_refused(
    arguments: tuple[str, ...], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["passes", *arguments]) == 2
    assert reason in capsys.readouterr().err


def test_a_day_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "day.png"
    assert main(["day", *FROM_NOON, *BERLIN, "--picture", str(file)]) == 0
    assert capsys.readouterr().out == f"picture: {file}\n"
    with Image.open(file) as picture:
        assert picture.width > 1000
