"""CSV files hold what the packets hold, to the last bit."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from flight.gnc.errors import UsageError
from flight.link.telemetry.definitions import EVENT
from flight.link.telemetry.log import FlightLog
from flight.link.telemetry.packets import Packer
from flight.link.telemetry.reader import read_run
from ground.export import export
from tests.ground.report.synthetic import Recipe, make_run
from tests.manual_clock import ManualClock


def read(path: Path) -> tuple[list[str], list[str], list[list[str]]]:
    with path.open(newline="", encoding="utf-8") as file:
        names, units, *rows = csv.reader(file)
    return names, units, rows


def test_every_kind_of_packet_that_came_has_its_file(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run", Recipe(duration=30.0, hold=10.0, rate_hz=10.0)))
    files = export(run, tmp_path / "csv")
    kinds = {
        "run", "control", "target", "plan", "streak", "stars", "event", "truth", "cycle_timing", "rate_group"
    }  # fmt: skip
    assert {path.stem for path in files} == kinds | {"job_timing"}
    assert sorted(files) == sorted((tmp_path / "csv").iterdir())


def test_numbers_come_back_exactly_under_their_names_and_units(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run", Recipe(duration=20.0, hold=10.0, rate_hz=10.0)))
    export(run, tmp_path / "csv")
    names, units, rows = read(tmp_path / "csv" / "truth.csv")
    assert names[:6] == ["time_s", "quaternion_1", "quaternion_2", "quaternion_3", "quaternion_4", "rate_1"]
    assert units[:6] == ["# s", "-", "-", "-", "-", "rad/s"]
    table = np.array(rows, dtype=float)
    np.testing.assert_array_equal(table[:, 0], np.arange(201) / 10.0)
    np.testing.assert_array_equal(table[:, 1:5], run["truth"]["quaternion"])
    np.testing.assert_array_equal(table[:, -2], run["truth"]["energy"])


def test_numpy_reads_a_file_by_its_column_names(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run", Recipe(duration=5.0, rate_hz=10.0)))
    export(run, tmp_path / "csv")
    table = np.genfromtxt(tmp_path / "csv" / "control.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(table["q2"], run["control"]["q2"])


def test_texts_with_commas_quotes_and_accents_survive(tmp_path: Path) -> None:
    text = 'said "no, thank you", été\nsecond line'
    log = FlightLog(tmp_path, clock=ManualClock())
    log.write(Packer().pack(EVENT, 1, code=1, severity=0, suppressed=0, name="a", text=text))
    log.close()
    (path,) = export(read_run(tmp_path), tmp_path / "csv")
    names, _, rows = read(path)
    assert dict(zip(names, rows[0], strict=True))["text"] == text


def test_a_place_that_cannot_be_written_is_a_clear_error(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run", Recipe(duration=1.0, rate_hz=10.0)))
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UsageError, match="no CSV can be written there"):
        export(run, tmp_path / "file")
