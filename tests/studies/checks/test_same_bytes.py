"""The comparison of two checkouts finds a planted difference and passes what may differ."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from flight.link.telemetry.definitions import EVENT, IMU, RUN, TARGET
from flight.link.telemetry.form import Field, Packet
from flight.link.telemetry.packets import Packer, compile_layouts
from tests.studies.same_bytes.__main__ import main
from tests.studies.same_bytes.comparison import Verdict, compare
from tests.studies.same_bytes.flights import (
    FLIGHTS,
    TABLE_FILE,
    FlightError,
    check_out,
    packet_table,
    resolve,
)

OLD = (RUN, IMU, TARGET)
RUN_VALUES: dict[str, object] = {
    "config_name": "synthetic",
    "config_crc": 1,
    "software": "1.0",
    "seed": 1,
    "utc_ns": 5,
    "simulated": 1,
    "realtime": 0,
    "control_period_ns": 25_000_000,
    "duration": 1.0,
    "coil_resistance": [23.0, 23.0, 23.0],
    "supply_voltage": 3.4,
    "current_limit": 0.148,
}


def imu(time_ns: int) -> dict[str, object]:
    values: dict[str, object] = {"sample_time_ns": time_ns, "device_time_ns": time_ns}
    return {
        **values,
        "quaternion": [0, 0, 0, 1],
        "rate": [0, 0, 1e-3],
        "field": [0] * 3,
        "acceleration": [0] * 3,
    }


class Writer:
    """Writes a synthetic flight log and its table into a folder."""

    def __init__(self, folder: Path, table: tuple[Packet, ...]) -> None:
        self.folder, self.table = folder, table
        self._packer = Packer(compile_layouts(table))
        self._packets: list[bytes] = []

    def add(self, packet: Packet, time_ns: int, values: dict[str, object]) -> None:
        self._packets.append(self._packer.pack(packet, time_ns, values))

    def close(self) -> Path:
        self.folder.mkdir()
        (self.folder / "flight-0001.ccsds").write_bytes(b"".join(self._packets))
        (self.folder / TABLE_FILE).write_text(json.dumps([asdict(packet) for packet in self.table]))
        return self.folder


def old_log(folder: Path) -> Path:
    writer = Writer(folder, OLD)
    writer.add(RUN, 0, RUN_VALUES)
    for cycle in range(4):
        writer.add(IMU, cycle * 25_000_000, imu(cycle * 25_000_000))
    writer.add(TARGET, 75_000_000, {"index": 0, "q2": -0.3, "rate": 0.0})
    return writer.close()


def new_log(
    folder: Path,
    table: tuple[Packet, ...] = OLD,
    run: dict[str, object] | None = None,
    third_rate: float = 1e-3,
    target: dict[str, object] | None = None,
    events: int = 0,
    samples: int = 4,
) -> Path:
    writer = Writer(folder, table)
    by_name = {packet.name: packet for packet in table}
    writer.add(by_name["run"], 0, RUN_VALUES | (run or {}))
    for cycle in range(samples):
        for _ in range(events):
            values = {"code": 1, "severity": 0, "suppressed": 0, "name": "started", "text": "x"}
            writer.add(by_name["event"], cycle, values)
        values = imu(cycle * 25_000_000)
        writer.add(IMU, cycle * 25_000_000, values | ({"rate": [0, 0, third_rate]} if cycle == 2 else {}))
    writer.add(by_name["target"], 75_000_000, target or {"index": 0, "q2": -0.3, "rate": 0.0})
    return writer.close()


def verdict(folder: Path, **changes: object) -> Verdict:
    return compare("synthetic", old_log(folder / "old"), new_log(folder / "new", **changes))  # type: ignore[arg-type]  # names of new_log's own arguments


def test_equal_logs_are_equal(tmp_path: Path) -> None:
    found = verdict(tmp_path)
    assert found.difference is None
    assert (found.compared, found.added, found.extended) == (6, {}, 0)


def test_the_last_bit_of_one_number_is_found(tmp_path: Path) -> None:
    first = verdict(tmp_path, third_rate=1e-3 + 2.0**-62).difference
    assert first is not None
    assert (first.log, first.packet, first.time, first.field) == ("flight", "imu", 0.05, "rate")
    assert first.old == "[2] 0.001"
    assert first.new != first.old


def test_a_missing_packet_is_found(tmp_path: Path) -> None:
    first = verdict(tmp_path, samples=3).difference
    assert first is not None
    assert (first.old, first.new) == ("imu", "target")


def test_a_log_that_ends_early_is_found(tmp_path: Path) -> None:
    old, new = old_log(tmp_path / "old"), new_log(tmp_path / "new")
    log = new / "flight-0001.ccsds"
    whole = log.read_bytes()
    log.write_bytes(whole[: -compile_layouts(OLD)["target"].length])
    first = compare("synthetic", old, new).difference
    assert first is not None
    assert (first.old, first.new) == ("target", "end of log")


def test_packets_that_the_old_table_does_not_have_are_counted_and_left_out(tmp_path: Path) -> None:
    found = verdict(tmp_path, table=(*OLD, EVENT), events=2)
    assert found.difference is None
    assert found.added == {"event": 8}
    assert found.compared == 6


def test_labels_may_differ_and_other_fields_of_run_may_not(tmp_path: Path) -> None:
    (tmp_path / "labels").mkdir()
    (tmp_path / "seed").mkdir()
    labels = {"utc_ns": 6, "software": "2.0", "config_crc": 2}
    assert verdict(tmp_path / "labels", run=labels).difference is None
    first = verdict(tmp_path / "seed", run={"seed": 2}).difference
    assert first is not None
    assert (first.field, first.old, first.new) == ("seed", "1", "2")


def test_an_appended_field_with_a_raised_version_is_left_out(tmp_path: Path) -> None:
    longer = replace(
        TARGET, version=TARGET.version + 1, fields=(*TARGET.fields, Field("hold", "f8", "s", "time to hold"))
    )
    table = (RUN, IMU, longer)
    for name, q2 in (("same", -0.3), ("other", -0.31)):
        (tmp_path / name).mkdir()
        target = {"index": 0, "q2": q2, "rate": 0.0, "hold": 3.0}
        found = verdict(tmp_path / name, table=table, target=target)
        if name == "same":
            assert (found.difference, found.extended) == (None, 1)
        else:
            assert found.difference is not None
            assert (found.difference.packet, found.difference.field) == ("target", "q2")


def test_reworded_meanings_make_no_difference(tmp_path: Path) -> None:
    reworded = replace(RUN, meaning="other words", fields=tuple(replace(f, meaning="x") for f in RUN.fields))
    assert verdict(tmp_path, table=(reworded, IMU, TARGET), run={"utc_ns": 9}).difference is None


def test_seven_flights_are_compared() -> None:
    assert len(FLIGHTS) == 7
    assert {flight.config for flight in FLIGHTS if flight.duration is None} == {
        "config/step_demo.yaml",
        "config/step_thesis.yaml",
    }


def test_an_unknown_revision_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--against", "no-such-revision"]) == 2
    assert capsys.readouterr().err.startswith("same_bytes: git rev-parse")


def test_the_packet_table_is_the_checkouts_own_in_the_old_layout_too(tmp_path: Path) -> None:
    """An editable installation of this project must not stand in for a module that the checkout lacks."""
    definitions = tmp_path / "flight/telemetry/definitions.py"
    definitions.parent.mkdir(parents=True)
    for folder in (tmp_path / "flight", definitions.parent):
        (folder / "__init__.py").touch()
    definitions.write_text(
        "from dataclasses import dataclass\n@dataclass\nclass P:\n    name: str\nPACKETS = (P('own'),)\n"
    )
    assert json.loads(packet_table(tmp_path)) == [{"name": "own"}]


@pytest.mark.slow
def test_a_short_flight_of_the_last_commit_repeats_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both sides are check-outs of HEAD, so that changes not yet committed do not matter."""
    try:
        commit = resolve("HEAD")
    except FlightError as error:
        pytest.skip(f"not a git checkout: {error}")
    checkout = tmp_path / "checkout"
    check_out(commit, checkout)
    monkeypatch.setattr("tests.studies.same_bytes.__main__.repository", lambda: checkout)
    status = main(["--against", "HEAD", "--only", "short", "--cache", str(tmp_path / "cache"), "--json"])
    printed = json.loads(capsys.readouterr().out)
    assert [flight["flight"] for flight in printed["flights"]] == ["short"]
    assert status == 0, printed
    assert printed["flights"][0]["compared"] > 900
