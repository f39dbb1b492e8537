"""A log that grows is read packet by packet, each once, wherever it was cut between two looks."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from flight.link.telemetry.log import find_segments
from ground.telemetry import read_run
from ground.watch.tail import LogTail
from knightcube.errors import UsageError
from tests.ground.report.synthetic import Recipe, make_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run"), Recipe(duration=6.0, rate_hz=10.0, hold=3.0))


@pytest.mark.parametrize("step", [997, 20_000, 10**9])
def test_every_packet_comes_once_and_in_order(run: Path, tmp_path: Path, step: int) -> None:
    data = (run / "flight-0001.ccsds").read_bytes()
    path = tmp_path / "flight-0001.ccsds"
    path.touch()
    tail, came = LogTail(tmp_path), []
    for start in range(0, len(data), step):
        with path.open("ab") as file:
            file.write(data[start : start + step])
        came.append(tail.new())
    whole = read_run(run).flight.packets
    for name, rows in whole.items():
        joined = np.concatenate([found[name] for found in came])
        np.testing.assert_array_equal(joined["time_ns"], rows["time_ns"])
    assert all(not len(rows) for rows in tail.new().values())


def test_the_next_segment_is_read_when_it_begins_and_the_end_of_the_last_is_not_lost(
    run: Path, tmp_path: Path
) -> None:
    data = (run / "flight-0001.ccsds").read_bytes()
    first, second = (tmp_path / f"flight-{number}.ccsds" for number in ("9999", "10000"))
    first.write_bytes(data[:5000])
    tail = LogTail(tmp_path)
    count = sum(map(len, tail.new().values()))
    with first.open("ab") as file:
        file.write(data[5000:9000])
    second.write_bytes(data[9000:])
    count += sum(map(len, tail.new().values()))
    assert count == sum(read_run(run).flight.counts.values())
    assert find_segments(tmp_path, "flight") == [first, second]


def test_a_segment_that_is_dropped_meanwhile_is_passed_over(run: Path, tmp_path: Path) -> None:
    shutil.copy(run / "flight-0001.ccsds", tmp_path)
    tail = LogTail(tmp_path)
    tail.new()
    (tmp_path / "flight-0001.ccsds").rename(tmp_path / "flight-0007.ccsds")
    assert len(tail.new()["control"]) == 61


def test_silence_is_counted_from_the_last_byte_and_of_an_old_log_from_its_file(
    run: Path, tmp_path: Path
) -> None:
    path = tmp_path / "flight-0001.ccsds"
    data = (run / "flight-0001.ccsds").read_bytes()
    path.write_bytes(data[:3000])
    os.utime(path, (time.time() - 500.0,) * 2)
    tail = LogTail(tmp_path)
    tail.new()
    assert tail.silence == pytest.approx(500.0, abs=5.0)
    with path.open("ab") as file:
        file.write(data[3000:])
    tail.new()
    assert tail.silence < 5.0


def test_a_folder_without_a_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no flight log"):
        LogTail(tmp_path)
    with pytest.raises(UsageError, match="no such folder"):
        LogTail(tmp_path / "none")
