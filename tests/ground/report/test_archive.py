"""The report of an archive has a row for every boot, and marks those that did not end by themselves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flight.app.cli import main
from ground.report.archive import format_archive, summarise_archive
from tests.ground.report.synthetic import Recipe, make_run

SHORT = Recipe(duration=4.0, planned=4.0, hold=2.0, rate_hz=10.0)


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Return an archive of a whole run, one with a torn tail, one without a log, and something else."""
    make_run(tmp_path / "run-000001", SHORT)
    torn = make_run(tmp_path / "run-000002", SHORT) / "flight-0001.ccsds"
    torn.write_bytes(torn.read_bytes()[:-30])
    (tmp_path / "run-000003").mkdir()
    (tmp_path / "state-a.json").write_text("{}")
    return tmp_path


def test_each_boot_has_its_row_and_damage_shows(archive: Path) -> None:
    whole, torn, empty = summarise_archive(archive)["runs"]
    assert whole["duration_s"] == 4.0
    assert (whole["bad_bytes"], whole["missing_packets"]) == (0, 0)
    assert torn["bad_bytes"] > 0
    assert torn["packets"] == whole["packets"] - 1
    assert (empty["packets"], empty["end"]) == (0, "no flight log")
    text = format_archive(summarise_archive(archive))
    assert text.startswith(f"Archive {archive}: 3 runs")
    assert [line.split()[0] for line in text.splitlines()[2:]] == ["run-000001", "run-000002", "run-000003"]


def test_the_command_reports_an_archive_as_text_and_as_json(
    archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(archive)]) == 0
    assert "run-000002" in capsys.readouterr().out
    assert main(["report", str(archive), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["runs"]) == 3
