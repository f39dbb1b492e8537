"""Tests of reading packets from bytes and from a run, of the damage report, and of exported files."""

from __future__ import annotations

import csv
import math
import os
import sqlite3
import sys
import tracemalloc
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flight.link.telemetry.definitions import CONTROL, EVENT, HOUSEKEEPING, IMU, RUN, TARGET, TRUTH
from flight.link.telemetry.log import FlightLog, find_segments
from flight.link.telemetry.packets import LAYOUTS, Packer, TelemetryError, crc16, to_text
from ground import telemetry
from ground.telemetry import FORMATS, Run, ScanResult, decode, export, read_run, scan, with_sorted_events
from knightcube.errors import UsageError
from tests.flight.link.telemetry.samples import plain_contents, timing_packets
from tests.ground.commands.in_process import command
from tests.ground.report.synthetic import Recipe, make_run
from tests.manual_clock import ManualClock
from tests.pace import ordinary_seconds
from tests.support.packed_run import packed_run

SHORT = Recipe(duration=30.0, planned=30.0, hold=10.0, rate_hz=10.0)


def test_the_three_logs_of_a_run_are_read_by_packet_name(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run", SHORT))
    assert run["target"]["q2"].tolist() == [-0.3, -0.2, -0.1, 0.0]
    assert len(run["control"]) == len(run["truth"]) == len(run["cycle_timing"]) == 301
    assert len(run["imu"]) == 0
    assert all(log.intact for log in run.logs.values())


def test_a_run_on_hardware_has_no_truth(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path, Recipe(duration=5.0, rate_hz=10.0, truth=False, performance=False)))
    assert run.truth.counts == run.performance.counts == {}
    assert len(run["truth"]) == 0


def test_a_run_killed_between_two_bytes_is_read_to_its_last_whole_packet(tmp_path: Path) -> None:
    path = make_run(tmp_path, SHORT) / "flight-0001.ccsds"
    path.write_bytes(path.read_bytes()[:-1])
    run = read_run(tmp_path)
    assert run.flight.truncated_bytes > 0
    assert len(run["control"]) == 300


def test_segments_are_read_in_order_and_dropped_ones_are_known(tmp_path: Path) -> None:
    packets = timing_packets(100)
    log = FlightLog(tmp_path, clock=ManualClock(), segment_bytes=220, budget_bytes=2200)
    for packet in packets:
        log.write(packet)
    log.close()
    run = read_run(tmp_path)
    assert run.dropped_segments("flight") == log.dropped_segments > 0
    kept = run["cycle_timing"]["cycle"].tolist()
    assert kept == list(range(kept[0], 100))
    assert run.dropped_segments("truth") == 0


def held_back_events() -> list[tuple[float, dict[str, Any]]]:
    return [
        (1.0, {"name": "a"}), (1.2, {"name": "b"}), (4.0, {"name": "c"}), (1.2, {"name": "d"}),
        (2.0, {"name": "a", "suppressed": 3}),
    ]  # fmt: skip


def test_events_that_were_held_back_are_sorted_by_their_times(tmp_path: Path) -> None:
    packets = with_sorted_events(packed_run(event=held_back_events()).flight.packets)
    assert [to_text(name) for name in packets["event"]["name"]] == ["a", "b", "d", "a", "c"]
    packer = Packer()
    values = {"code": 1, "severity": 0, "suppressed": 0, "text": ""}
    log = [packer.pack(EVENT, round(t * 1e9), {**values, **row}) for t, row in held_back_events()]
    (tmp_path / "flight-0001.ccsds").write_bytes(b"".join(log))
    assert read_run(tmp_path)["event"]["time_ns"].tolist() == packets["event"]["time_ns"].tolist()
    assert read_run(tmp_path).flight.intact


def test_a_tenth_thousand_segment_comes_after_the_ninth(tmp_path: Path) -> None:
    first, second = timing_packets(2)
    (tmp_path / "flight-9999.ccsds").write_bytes(first)
    (tmp_path / "flight-10000.ccsds").write_bytes(second)
    assert read_run(tmp_path)["cycle_timing"]["cycle"].tolist() == [0, 1]


def test_a_folder_without_a_run_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such folder"):
        read_run(tmp_path / "nowhere")
    with pytest.raises(UsageError, match="no flight log"):
        read_run(tmp_path)
    (tmp_path / "archive/run-000007").mkdir(parents=True)
    with pytest.raises(UsageError, match=r"one run of this archive, such as .*archive/run-000007"):
        read_run(tmp_path / "archive")
    (tmp_path / "flight-0001.ccsds").write_bytes(b"not a log")
    with pytest.raises(UsageError, match="no valid packet in the 9 bytes"):
        read_run(tmp_path)


def test_segments_that_are_removed_meanwhile_are_a_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "flight-0001.ccsds").write_bytes(timing_packets(1)[0])

    def found(folder: Path, stem: str) -> list[Path]:
        paths = find_segments(folder, stem)
        for path in paths:
            path.unlink()
        return paths

    monkeypatch.setattr(telemetry, "find_segments", found)
    with pytest.raises(UsageError, match="the flight log cannot be read: No such file"):
        read_run(tmp_path)


def cycles(result: ScanResult) -> list[int]:
    return [int(cycle) for cycle in result.packets["cycle_timing"]["cycle"]]


def claimed(result: ScanResult) -> int:
    return sum(LAYOUTS[name].length * count for name, count in result.counts.items())


def test_an_empty_log_has_no_packets() -> None:
    result = scan(b"")
    assert result.counts == {}
    assert result.intact
    assert result.packets["control"]["q2"].shape == (0,)


def test_an_undamaged_log_is_intact() -> None:
    packets = timing_packets(100)
    result = scan(b"".join(packets))
    assert result.counts == {"cycle_timing": 100}
    assert cycles(result) == list(range(100))
    assert result.intact


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=200), st.binary(max_size=200), st.binary(max_size=200))
def test_garbage_around_packets_loses_none_of_them(before: bytes, between: bytes, after: bytes) -> None:
    first, second = timing_packets(2)
    result = scan(before + first + between + second + after)
    assert cycles(result) == [0, 1]
    assert result.skipped_bytes + result.truncated_bytes == len(before + between + after)


@settings(max_examples=80, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.binary(max_size=40),
            st.sampled_from(timing_packets(3)),
            st.sampled_from([layout.identifier.to_bytes(2, "big") for layout in LAYOUTS.values()]),
        )
    )
)
def test_every_byte_of_any_stretch_is_accounted_for(pieces: list[bytes]) -> None:
    data = b"".join(pieces)
    result = scan(data)
    assert claimed(result) + result.skipped_bytes + result.truncated_bytes == result.total_bytes == len(data)
    assert result.skipped_bytes >= 0
    assert result.truncated_bytes >= 0


def test_one_damaged_byte_costs_one_packet_and_shows_in_the_sequence() -> None:
    packets = timing_packets(5)
    length = len(packets[0])
    for position in range(length):
        for flip in (0x01, 0x80, 0xFF):
            data = bytearray(b"".join(packets))
            data[2 * length + position] ^= flip
            result = scan(bytes(data))
            assert cycles(result) == [0, 1, 3, 4]
            assert result.skipped_bytes == length
            assert result.missing["cycle_timing"] == 1


def test_bytes_lost_in_the_middle_cost_the_packets_they_touch() -> None:
    packets = timing_packets(6)
    length = len(packets[0])
    data = b"".join(packets)
    result = scan(data[: length + 10] + data[2 * length + 20 :])
    assert cycles(result) == [0, 3, 4, 5]
    assert result.missing["cycle_timing"] == 2


def test_sequence_gaps_are_counted_across_the_wrap() -> None:
    packer = Packer()
    packets = timing_packets((1 << 14) + 10, packer)
    kept = packets[: (1 << 14) - 3] + packets[(1 << 14) + 5 :]
    assert scan(b"".join(kept)).missing["cycle_timing"] == 8


def test_a_packet_of_another_version_is_skipped_and_counted() -> None:
    first, second = timing_packets(2)
    other = bytearray(first[:-2] + b"one field more")
    other[4:6] = (len(other) + 2 - 7).to_bytes(2, "big")
    other[6] += 1
    newer = bytes(other) + crc16(bytes(other)).to_bytes(2, "big")
    result = scan(first + newer + second)
    assert cycles(result) == [0, 1]
    assert (result.other_versions, result.skipped_bytes) == (1, 0)
    assert not result.intact


@pytest.mark.parametrize("byte", [0, 1, 2], ids=["version bits", "apid", "sequence"])
def test_a_foreign_header_is_refused_even_with_a_valid_crc(byte: int) -> None:
    packet = bytearray(timing_packets(1)[0][:-2])
    if byte == 0:
        packet[0] |= 0x20
    elif byte == 1:
        packet[1] = 0xEE
    else:
        packet[4:6] = (len(packet) + 3 - 7).to_bytes(2, "big")
    assert scan(bytes(packet) + crc16(bytes(packet)).to_bytes(2, "big")).counts == {}


def test_decode_takes_whole_packets_only() -> None:
    packets = timing_packets(3)
    assert decode(b"".join(packets))["cycle_timing"]["cycle"].tolist() == [0, 1, 2]
    with pytest.raises(TelemetryError, match="1 bytes belong to no packet"):
        decode(b"".join(packets) + b"x")


def test_kinds_of_packets_are_distinguished_in_order() -> None:
    packer = Packer()
    kinds = [IMU, CONTROL, TARGET, IMU, EVENT, IMU]
    data = b"".join(packer.pack(kind, i, plain_contents(kind)) for i, kind in enumerate(kinds))
    result = scan(data)
    assert result.counts == {"imu": 3, "control": 1, "target": 1, "event": 1}
    assert result.packets["imu"]["time_ns"].tolist() == [0, 3, 5]
    assert result.intact


def log(cycles: int) -> bytes:
    """Return the packets of `cycles` control cycles, each with an IMU, a control and a truth packet."""
    packer = Packer()
    kinds = [(kind, plain_contents(kind)) for kind in (IMU, CONTROL, TRUTH)]
    return b"".join(packer.pack(kind, cycle, values) for cycle in range(cycles) for kind, values in kinds)


def test_a_log_four_times_as_long_takes_about_four_times_as_long() -> None:
    short, long = log(1_000), log(4_000)
    assert scan(long).counts == {"imu": 4_000, "control": 4_000, "truth": 4_000}
    assert ordinary_seconds(lambda: scan(long), 5) < 6.0 * ordinary_seconds(lambda: scan(short), 5)


def test_noise_holds_no_packets() -> None:
    noise = np.random.default_rng(7).bytes(1_000_000)
    assert scan(noise).counts == {}


def read(path: Path) -> tuple[list[str], list[list[str]]]:
    with path.open(newline="", encoding="utf-8") as file:
        names, *rows = csv.reader(file)
    return names, rows


def test_every_kind_of_packet_that_came_has_its_file(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run", Recipe(duration=30.0, hold=10.0, rate_hz=10.0)))
    files = export(run, tmp_path / "csv")
    kinds = {
        *("run", "control", "target", "plan", "streak", "stars", "event", "truth"),
        *("cycle_timing", "rate_group", "job_timing", "housekeeping", "fields"),
    }
    assert {path.stem for path in files} == kinds
    assert sorted(files) == sorted((tmp_path / "csv").iterdir())


def test_numbers_come_back_exactly_under_their_names_and_units(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run", Recipe(duration=20.0, hold=10.0, rate_hz=10.0)))
    export(run, tmp_path / "csv")
    names, rows = read(tmp_path / "csv" / "truth.csv")
    assert names[:6] == ["time_s", "quaternion_1", "quaternion_2", "quaternion_3", "quaternion_4", "rate_1"]
    _, fields = read(tmp_path / "csv" / "fields.csv")
    own = [field for field in fields if field[0] == "truth"]
    assert [field[1] for field in own] == names
    assert [field[2] for field in own[:6]] == ["s", "-", "-", "-", "-", "rad/s"]
    assert own[1][3] == "rotation of reference frame into body, scalar last"
    table = np.array(rows, dtype=float)
    np.testing.assert_array_equal(table[:, 0], np.arange(201) / 10.0)
    np.testing.assert_array_equal(table[:, 1:5], run["truth"]["quaternion"])
    np.testing.assert_array_equal(table[:, -2], run["truth"]["energy"])


@pytest.mark.parametrize(
    ("utc_ns", "utc"), [(1_774_008_001_000_000_000, "2026-03-20T12:00:16.450Z"), (0, ""), (None, "")]
)
def test_events_have_their_utc_if_the_flight_knows_it(utc_ns: int | None, utc: str, tmp_path: Path) -> None:
    happened = [(15.45, {"name": "camera-saturated"})]
    labels = [] if utc_ns is None else [(0.0, {"utc_ns": utc_ns})]
    run = packed_run(event=happened, run=labels)
    export(run, tmp_path)
    names, rows = read(tmp_path / "event.csv")
    assert dict(zip(names, rows[0], strict=True))["utc"] == utc


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
    path, _ = export(read_run(tmp_path), tmp_path / "csv")
    names, rows = read(path)
    assert dict(zip(names, rows[0], strict=True))["text"] == text


def test_a_place_that_cannot_be_written_is_a_clear_error(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run", Recipe(duration=1.0, rate_hz=10.0)))
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UsageError, match="csv cannot be written"):
        export(run, tmp_path / "file")


@pytest.fixture
def rich_run(tmp_path: Path) -> Run:
    """Return a run with texts, NaN, and 64-bit integers."""
    log = FlightLog(tmp_path / "run", clock=ManualClock())
    packer = Packer()
    for n in range(3):
        values = {"imu_packets": 7 + n, "coil_voltage": np.nan if n else 5.0}
        fields = {field.name: values.get(field.name, 0) for field in HOUSEKEEPING.fields}
        log.write(packer.pack(HOUSEKEEPING, n * 10**9, fields))
    identity = {f.name: [1.0] * 3 if f.count == 3 else "é" if f.kind[0] == "S" else 1 for f in RUN.fields}
    log.write(packer.pack(RUN, 0, {**identity, "seed": 2**64 - 1}))
    log.write(packer.pack(EVENT, 1, code=1, severity=0, suppressed=0, name="a", text='x "y", z\n'))
    log.close()
    return read_run(tmp_path / "run")


@pytest.mark.parametrize("form", ["csv", "parquet"])
@pytest.mark.parametrize("reader", ["pyarrow", "pandas", "polars", "duckdb"])
def test_readers_of_other_authors_need_no_options(
    rich_run: Run, tmp_path: Path, reader: str, form: str
) -> None:
    """Other programs read the exported files without options.

    NaN is read as a number, and texts keep their quotes and accents.
    """
    module = pytest.importorskip(f"pyarrow.{form}" if reader == "pyarrow" else reader)
    pytest.importorskip("pyarrow", reason="needs the extra `parquet`")
    files = {path.stem: str(path) for path in export(rich_run, tmp_path / form, form)}

    def column(packet: str, name: str) -> list[Any]:
        if reader == "duckdb":
            rows = module.sql(f"SELECT {name} FROM '{files[packet]}'").fetchall()
            return [row[0] for row in rows]
        read = getattr(module, f"read_{'table' if (reader, form) == ('pyarrow', 'parquet') else form}")
        values = read(files[packet])[name]
        return list(values.to_pylist() if reader == "pyarrow" else values.to_list())

    assert column("housekeeping", "imu_packets") == [7, 8, 9]
    voltage = [math.nan if value is None else value for value in column("housekeeping", "coil_voltage")]
    np.testing.assert_array_equal(voltage, [5.0, math.nan, math.nan])
    assert column("run", "config_name") == ["é"]
    if form == "parquet":  # pyarrow reads unsigned 64-bit integers in CSV files as floating-point numbers
        assert column("run", "seed") == [2**64 - 1]


def test_one_sqlite_file_has_a_table_for_each_packet_and_the_units(rich_run: Run, tmp_path: Path) -> None:
    file = tmp_path / "new" / "all.sqlite"
    for _ in range(2):  # the second export replaces the files of the first
        assert export(rich_run, file, "sqlite") == [file]
    assert list(file.parent.iterdir()) == [file]
    with closing(sqlite3.connect(file)) as database:
        rows = database.execute("SELECT time_s, imu_packets, coil_voltage FROM housekeeping").fetchall()
        assert rows == [(0.0, 7, 5.0), (1.0, 8, None), (2.0, 9, None)]
        assert database.execute("SELECT seed, config_name, coil_resistance_3 FROM run").fetchall() == [
            (str(2**64 - 1), "é", 1.0)
        ]
        assert database.execute("SELECT text FROM event").fetchone() == ('x "y", z\n',)
        unit = "SELECT unit FROM fields WHERE packet = 'housekeeping' AND name = 'coil_voltage'"
        assert database.execute(unit).fetchone() == ("V",)


def test_parquet_files_hold_every_number_with_its_unit(rich_run: Run, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `parquet`")
    files = {path.stem: path for path in export(rich_run, tmp_path / "parquet", "parquet")}
    assert set(files) == {"run", "event", "housekeeping"}
    table = parquet.read_table(files["housekeeping"])
    np.testing.assert_array_equal(table["coil_voltage"].to_numpy(), [5.0, np.nan, np.nan])
    np.testing.assert_array_equal(table["imu_packets"].to_numpy(), [7, 8, 9])
    assert table.schema.field("coil_voltage").metadata[b"unit"] == b"V"
    identity = parquet.read_table(files["run"])
    assert identity["seed"].to_pylist() == [2**64 - 1]
    assert identity["config_name"].to_pylist() == ["é"]


def test_a_log_needs_little_more_than_twice_its_size_in_memory_while_it_is_read() -> None:
    """The measured memory excludes the log itself. A log of two days has a size of one gigabyte."""
    packer, packets = Packer(), []
    for second in range(2000):
        packets += [packer.pack(kind, second, plain_contents(kind)) for kind in (CONTROL, HOUSEKEEPING)]
    data = b"".join(packets)
    tracemalloc.start()
    scan(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2.0 * len(data)


@pytest.mark.parametrize("form", FORMATS)
def test_a_run_is_exported_to_a_path_that_is_not_utf_8(form: str, rich_run: Run, tmp_path: Path) -> None:
    if form == "parquet":
        pytest.importorskip("pyarrow", reason="needs the extra `parquet`")
    files = export(rich_run, tmp_path / os.fsdecode(b"\xff"), form)
    assert files
    assert all(path.stat().st_size for path in files)


def test_all_formats_have_the_same_columns(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `parquet`")
    run = read_run(make_run(tmp_path / "run", Recipe(duration=2.0, rate_hz=10.0)))
    export(run, tmp_path / "csv")
    export(run, tmp_path / "parquet", "parquet")
    export(run, tmp_path / "one.sqlite", "sqlite")
    with closing(sqlite3.connect(tmp_path / "one.sqlite")) as database:
        for path in (tmp_path / "csv").iterdir():
            names, rows = read(path)
            if path.stem == "fields":
                continue
            assert parquet.read_schema(tmp_path / "parquet" / f"{path.stem}.parquet").names == names
            cursor = database.execute(f'SELECT * FROM "{path.stem}"')
            assert [column[0] for column in cursor.description] == names
            assert len(cursor.fetchall()) == len(rows)


def test_without_pyarrow_the_cure_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = read_run(make_run(tmp_path / "run", Recipe(duration=1.0, rate_hz=10.0)))
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"pip install 'knightcube-flight\[parquet\]'"):
        export(run, tmp_path / "parquet", "parquet")


@pytest.mark.parametrize("form", ["parquet", "sqlite"])
def test_a_path_that_cannot_be_written_is_refused_by_each_format(tmp_path: Path, form: str) -> None:
    run = read_run(make_run(tmp_path / "run", Recipe(duration=1.0, rate_hz=10.0)))
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UsageError, match=f"{form} cannot be written"):
        export(run, tmp_path / "file" / "x", form)
    (tmp_path / "folder.sqlite").mkdir()
    if form == "sqlite":
        with pytest.raises(UsageError, match="sqlite cannot be written"):
            export(run, tmp_path / "folder.sqlite", form)


def test_the_command_names_the_file_that_it_wrote(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", Recipe(duration=1.0, rate_hz=10.0))
    done = command("export", folder, "--format", "sqlite")
    assert (done.returncode, done.stdout) == (0, f"{folder / 'run.sqlite'}\n"), done.stderr
    assert command("export", folder, "--format", "xml").returncode == 2
