"""Tests of the commands `passes` and `day`: output, plots and refusals."""

from __future__ import annotations

import argparse
import json
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from PIL import Image

from flight.app.cli import main
from flight.link.process import directives
from flight.link.process.directives import Scheduled
from ground.commands import satellite
from tests.support.orbit_elements import POLAR_ORBIT

ORBIT = ("orbit_3u", "--from", "2026-03-20T12:00:00")
BERLIN = ("--station", "Berlin,52.5,13.4")


def test_the_table_and_the_object_have_the_same_passes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["passes", *ORBIT, *BERLIN]) == 0
    rows = capsys.readouterr().out.splitlines()[1:-1]
    assert main(["passes", *ORBIT, *BERLIN, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["passes"]
    rises = [datetime.fromisoformat(one["rise_utc"]).strftime("%Y-%m-%d %H:%M:%S") for one in found]
    assert [" ".join(row.split()[1:3]) for row in rows] == rises
    assert len(rises) >= 3


def test_the_schedule_consists_of_commands_that_can_be_sent(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["passes", *ORBIT, *BERLIN, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["passes"]
    assert main(["passes", *ORBIT, *BERLIN, "--schedule", "--lead", "90"]) == 0
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


def test_elements_may_stand_in_a_file_of_their_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "elements.txt"
    file.write_text("SATELLITE\n" + "\n".join(POLAR_ORBIT) + "\n")
    assert main(["passes", str(file), "--from", "2026-03-20T12:00:00", *BERLIN]) == 0
    assert "Berlin" in capsys.readouterr().out


def test_old_elements_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["passes", "orbit_3u", "--from", "2026-12-20T12:00:00", *BERLIN]) == 0
    assert "the elements are old" in capsys.readouterr().err


def test_a_station_that_never_sees_the_satellite_has_no_pass(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["passes", *ORBIT, "--station", "Berlin,52.5,13.4,0,89.9", "--days", "0.1"]) == 1
    assert capsys.readouterr().out == "no pass\n"


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (ORBIT, "give a ground station"),
        ((*ORBIT, *BERLIN, *BERLIN), "two stations are called 'Berlin'"),
        ((*ORBIT, *BERLIN, "--days", "31"), "--days 31: must be at most 30"),
        (("step_demo", *BERLIN), "this needs the configuration of a satellite"),
    ],
)
def test_a_wrong_use_is_refused(
    arguments: tuple[str, ...], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["passes", *arguments]) == 2
    assert reason in capsys.readouterr().err


def test_a_day_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "day.png"
    assert main(["day", *ORBIT, *BERLIN, "--picture", str(file)]) == 0
    assert capsys.readouterr().out == f"picture: {file}\n"
    with Image.open(file) as picture:
        assert picture.width > 1000
