"""Tests of `knightcube watch` with a finished, a growing and a stalled log, and with a listening flight."""

from __future__ import annotations

import argparse
import errno
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.link import events
from flight.link.process.commanding import Stage
from flight.link.telemetry.definitions import (
    ATTITUDE,
    CONTROL,
    EVENT,
    FACTS,
    HEALTH,
    LINK,
    MODE,
    PACKETS,
    RUN,
    VERIFICATION,
    Packet,
)
from flight.link.telemetry.log import find_segments
from flight.link.telemetry.packets import LAYOUTS, Packer, PacketArray
from ground import watch
from ground.commands import station
from ground.telemetry import read_run, scan
from ground.watch import (
    LISTED_EVENTS,
    FlightState,
    LoggedEvent,
    LogTail,
    PlainLines,
    event_line,
    panel,
    state_line,
)
from knightcube.errors import UsageError
from tests.ground.commands.in_process import command
from tests.ground.report.synthetic import Recipe, make_run
from tests.support.answering_flight import Listener, answer
from tests.support.places import ROOT


def pack(packer: Packer, packet: Packet, time_s: float, **values: object) -> bytes:
    """Return a packet whose fields are zero or empty, except for the given fields."""
    fields: dict[str, object] = {}
    for field in packet.fields:
        value: object = "" if field.kind.startswith("S") else 0
        fields[field.name] = [value] * field.count if field.count > 1 else value
    return packer.pack(packet, round(time_s * 1e9), {**fields, **values})


def event(packer: Packer, kind: events.EventKind, time_s: float, text: str) -> bytes:
    severity = int(kind.severity)
    return pack(packer, EVENT, time_s, code=kind.code, severity=severity, name=kind.name, text=text)


def continued(folder: Path) -> Packer:
    """Return a packer whose sequence counts continue those of a log."""
    packer = Packer()
    for name, count in read_run(folder).flight.counts.items():
        packer._counts[name] = count
    return packer


@pytest.fixture
def growing(tmp_path: Path) -> Path:
    """Return the folder of an unfinished run with six seconds of packets and an event of severity fault."""
    folder = make_run(tmp_path / "run", Recipe(duration=6.0, rate_hz=10.0, hold=3.0))
    packer = continued(folder)
    with (folder / "flight-0001.ccsds").open("ab") as file:
        file.write(pack(packer, MODE, 5.5, before=0, mode=3, trigger="ready"))
        file.write(pack(packer, HEALTH, 5.6, mode=3, imu=5, coils=2, slips=4))
        file.write(event(packer, events.IMU_SILENT, 5.7, "0.2 s without a byte"))
    return folder


def end(folder: Path) -> None:
    packer = continued(folder)
    with (folder / "flight-0001.ccsds").open("ab") as file:
        file.write(event(packer, events.STOPPED, 6.5, "stopped by SIGTERM"))


def test_a_flight_that_is_over_is_shown_to_its_end(growing: Path) -> None:
    end(growing)
    done = command("watch", growing, "--every", "2")
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert sum("  fault    imu-silent: 0.2 s without a byte" in line for line in lines) == 1
    states = [line for line in lines if "mA" in line]
    assert [float(line.split()[0]) // 2 for line in states] == [0, 1, 2, 3]
    last = states[-1]
    for part in ("hold", "q2 ", "slips 4", "faults 1"):
        assert part in last
    assert lines[-1].endswith("mA  coils following  slips 4  alarms none  faults 1")
    assert any(line.endswith("stopped: stopped by SIGTERM") for line in lines)


def test_an_event_that_was_held_back_is_shown_at_its_time(growing: Path) -> None:
    packer = continued(growing)
    with (growing / "flight-0001.ccsds").open("ab") as file:
        file.write(event(packer, events.IMU_CORRUPT, 5.65, "3 bytes"))
        file.write(event(packer, events.STOPPED, 6.5, "stopped by SIGTERM"))
    lines = command("watch", growing, "--every", "2").stdout.splitlines()
    times = [float(line.split()[0]) for line in lines if "  warning  " in line or "  fault  " in line]
    assert times == [5.65, 5.7]
    seconds = (LogTail(growing).new()["event"]["time_ns"] / 1e9).tolist()
    assert seconds[-4:] == [5.65, 5.7, 6.0, 6.5]


def test_one_look_as_json_has_mode_currents_streams_and_events(growing: Path) -> None:
    facts = json.loads(command("watch", growing, "--json").stdout)
    assert (facts["mode"], facts["faults"], facts["ended"]) == ("hold", 1, None)
    assert facts["faults_since_s"] < 0.1
    assert facts["currents_a"] == [0.1, 0.0, 0.0]
    assert (facts["streams"]["imu"], facts["streams"]["coils"]) == ("good", "stale")
    (fault,) = [one for one in facts["events"] if one["severity"] == 2]
    assert fault == {
        "time_s": 5.7, "severity": 2, "name": "imu-silent", "text": "0.2 s without a byte", "suppressed": 0,
        "utc": "2023-11-14T22:13:25.700Z",
    }  # fmt: skip
    assert command("watch", growing, "--once").stdout.count("\n") == 1


def test_each_line_has_mission_time_and_utc(growing: Path) -> None:
    end(growing)
    lines = command("watch", growing, "--every", "2").stdout.splitlines()
    assert all(" s  2023-11-14T22:13:2" in line for line in lines), (
        "the columns of events and states are equal"
    )
    assert "    5.700 s  2023-11-14T22:13:25.700Z  fault    imu-silent: 0.2 s without a byte" in lines
    assert "  2023-11-14T22:13:26.500Z  " in command("watch", growing, "--once").stdout
    facts = json.loads(command("watch", growing, "--json").stdout)
    assert (facts["mission_time_s"], facts["utc"]) == (6.5, "2023-11-14T22:13:26.500Z")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "no valid packet in the 0 bytes of the flight log"),
        (bytes(5000), "no valid packet in the 5000 bytes of the flight log"),
        (None, "the flight log is damaged: 7 bytes are damaged"),
    ],
)
def test_a_damaged_log_is_reported(growing: Path, content: bytes | None, problem: str) -> None:
    log = growing / "flight-0001.ccsds"
    whole = log.read_bytes()
    last = len(event(Packer(), events.IMU_SILENT, 5.7, ""))
    log.write_bytes(whole[:-last] + b"x" * 7 + whole[-last:] if content is None else content)
    done = command("watch", growing, "--once")
    assert done.stderr.endswith(f"knightcube: {growing}: {problem}\n")


def test_packets_missing_at_the_beginning_of_a_log_are_counted(growing: Path) -> None:
    log = growing / "flight-0001.ccsds"
    whole = read_run(growing).flight
    log.write_bytes(log.read_bytes()[whole.total_bytes // 2 :])
    cut = read_run(growing).flight
    lost = sum(whole.counts.values()) - sum(cut.counts.values())
    absent = sum(count for name, count in whole.counts.items() if name not in cut.counts)
    assert sum(cut.missing.values()) == lost - absent > 0
    assert f", {lost - absent} packets are missing" in command("watch", growing, "--once").stderr
    log.rename(growing / "flight-0002.ccsds")  # older segments were deleted by the flight
    assert sum(read_run(growing).flight.missing.values()) == 0


def test_a_flight_without_faults_is_shown_with_their_number(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", Recipe(duration=2.0, rate_hz=10.0, hold=1.0))
    packer = continued(run)
    with (run / "flight-0001.ccsds").open("ab") as file:
        file.write(pack(packer, HEALTH, 2.0, mode=3))
    assert "  faults 0  no packet for " in command("watch", run, "--once").stdout.replace(
        "\n", "  no packet for "
    )


def test_a_file_is_not_called_a_missing_folder(growing: Path) -> None:
    for name in ("watch", "console", "report", "export"):
        done = command(name, growing / "flight-0001.ccsds")
        assert done.returncode == 2
        assert f"is not a folder: give the folder of a run, such as {growing}" in done.stderr
    (growing.parent / "other.txt").touch()
    done = command("report", growing.parent / "other.txt")
    assert (done.returncode, done.stderr.endswith("give the folder of a run\n")) == (2, True)


def test_a_watch_of_a_log_that_does_not_grow_ends_after_its_patience_with_status_1(growing: Path) -> None:
    done = command("watch", growing, "--patience", "0.2")
    assert done.returncode == 1
    assert "the log has no stop event" in done.stderr


def test_an_archive_shows_its_newest_run(growing: Path, tmp_path: Path) -> None:
    for number in (1, 2):
        folder = tmp_path / "archive" / f"run-00000{number}"
        make_run(folder, Recipe(duration=1.0, rate_hz=10.0))
    growing.rename(tmp_path / "archive" / "run-000003")
    assert json.loads(command("watch", tmp_path / "archive", "--json").stdout)["mode"] == "hold"


@pytest.fixture
def watcher(growing: Path) -> Iterator[subprocess.Popen[str]]:
    """Yield a `watch` process of a growing log, after the process has printed its first lines."""
    words = [sys.executable, "-m", "flight", "watch", str(growing), "--every", "2"]
    with subprocess.Popen(
        words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        while "imu-silent" not in process.stdout.readline():
            pass
        yield process
        process.kill()


def test_new_packets_are_shown_and_the_end_of_the_flight_ends_the_watch(
    watcher: subprocess.Popen[str], growing: Path
) -> None:
    end(growing)
    output, complaint = watcher.communicate(timeout=20.0)
    assert (watcher.returncode, complaint) == (0, "")
    assert "stopped by SIGTERM" in output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_a_watch_in_order(watcher: subprocess.Popen[str], number: signal.Signals) -> None:
    watcher.send_signal(number)
    _, complaint = watcher.communicate(timeout=20.0)
    assert (watcher.returncode, complaint) == (0, "")


def test_a_damaged_log_does_not_steer_the_terminal_and_gives_lines_all_the_same() -> None:
    packer, view = Packer(), FlightState()
    lines: list[str] = []
    data = event(packer, events.STARTED, 1.0, "\x1b[2Jgone\x07\r")
    data += pack(packer, EVENT, -9e9, severity=200, name="odd", text="ü")
    data += pack(packer, MODE, 9e9, mode=77)
    for packet in PACKETS:
        wild = {field.name: _wild(field.kind, field.count) for field in packet.fields}
        data += packer.pack(packet, 2**62, wild)
    PlainLines(view, 10.0, lines.append).feed(scan(data).packets)
    text = "".join(lines)
    assert "?[2Jgone??" in text
    assert all(letter.isprintable() or letter == "\n" for letter in text)
    console = pytest.importorskip("rich.console").Console(record=True, width=100, file=io.StringIO())
    console.print(panel(view, 0.0))
    assert "\x1b" not in console.export_text()


def test_the_time_for_a_long_log_grows_with_its_length() -> None:
    """Four times as many packets, with a printed line per 400, take less than eight times as long."""

    def processor_time(lines: int) -> float:
        packets = {name: np.zeros(0, layout.dtype) for name, layout in LAYOUTS.items()}
        packets[ATTITUDE.name] = np.zeros(400 * lines, LAYOUTS[ATTITUDE.name].dtype)
        packets[ATTITUDE.name]["time_ns"] = np.arange(400 * lines) * 25_000_000
        written: list[str] = []
        begun = time.process_time()
        PlainLines(FlightState(), 10.0, written.append).feed(packets)
        assert len(written) == lines
        return time.process_time() - begun

    assert processor_time(3200) < 8.0 * min(processor_time(800) for _ in range(2))


def test_an_impossible_limit_of_the_current_does_not_lengthen_the_bars_of_the_panel() -> None:
    console = pytest.importorskip("rich.console").Console(record=True, width=100, file=io.StringIO())
    packer, view = Packer(), FlightState()
    data = pack(packer, RUN, 0.0, current_limit=-1e-3) + pack(packer, CONTROL, 0.0, current_written=[1.0] * 3)
    view.update(scan(data).packets)
    console.print(panel(view, 0.0))
    assert console.export_text().count("░") == 3 * 20


def _wild(kind: str, count: int) -> object:
    value: object = "\x1b]0;x" if kind.startswith("S") else np.nan if kind.startswith("f") else 255
    return [value] * count if count > 1 else value


def test_the_panel_shows_mode_attitude_currents_streams_and_the_newest_events(growing: Path) -> None:
    console = pytest.importorskip("rich.console").Console(record=True, width=100, file=io.StringIO())
    view = FlightState()
    view.update(scan((growing / "flight-0001.ccsds").read_bytes()).packets)
    packer = Packer()
    many = b"".join(event(packer, events.MODE, 6.0 + 0.1 * n, f"note {n}") for n in range(30))
    view.update(scan(many).packets)
    console.print(panel(view, 12.0))
    text = console.export_text()
    for part in (
        "hold", "of 700", "made-up, simulated", "q2 ", "coil x", "+100.0 mA ██████████████░", "imu good",
        "coils stale", "slips 4", "faults 1", "note 29", "no packet for 12 s",
    ):  # fmt: skip
        assert part in text, part
    assert f"note {30 - LISTED_EVENTS}" in text
    assert f"note {29 - LISTED_EVENTS}\n" not in text
    assert "nan" not in text


def test_a_body_without_an_estimate_has_no_attitude_and_one_without_currents_its_dipole() -> None:
    view, nothing = FlightState(), [float("nan")] * 4
    fields = {"quaternion": nothing, "rate": nothing[:3], "target": nothing, "dipole": [0.01, -0.02, 0.0]}
    view.update(scan(pack(Packer(), ATTITUDE, 1.0, mode=2, **fields)).packets)
    assert state_line(view) == "    1.000 s  detumble  dipole +10.00 -20.00 +0.00 mA m^2"


def test_a_terminal_without_rich_gets_lines_and_the_cure(
    growing: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rich.live", None)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    options = argparse.Namespace(plain=False, every=10.0)
    with station._display(options, FlightState(), LogTail(growing), lambda: 0.0) as refresh:
        refresh()
    shown = capsys.readouterr()
    assert "pip install 'knightcube-flight[watch]'" in shown.err
    assert shown.out.splitlines()


def test_a_flight_that_listens_is_asked_for_its_mode(tmp_path: Path) -> None:
    listener = Listener(tmp_path / "socket")
    facts = json.loads(command("watch", tmp_path / "socket", "--json").stdout)
    assert facts["mode"] == "hold"
    assert 0.0 < facts["answered_s"] < 2.0
    assert (facts["attitude"], facts["currents_a"], facts["events"]) == (None, None, [])
    listener.will_say(b"nonsense")
    done = command("watch", tmp_path / "socket", "--patience", "0.1")
    assert (done.returncode, done.stderr) == (1, f"knightcube: {tmp_path / 'socket'}: no answer\n")


def test_the_state_and_events_of_an_answer_are_shown_and_each_event_once(
    tmp_path: Path, growing: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ground.commands.station._PING_S", 0.05)
    listener = Listener(tmp_path / "socket")
    log = scan((growing / "flight-0001.ccsds").read_bytes()).packets
    control = log["control"][-1:].tobytes()
    said = answer(True) + control + event(Packer(), events.IMU_SILENT, 5.7, "no byte")
    listener.will_say(said, said, said, b"x")
    lines = command("watch", tmp_path / "socket", "--patience", "0.2").stdout.splitlines()
    assert lines[0] == "    5.700 s  fault    imu-silent: no byte"
    assert len(lines) > 2
    for line in lines[1:]:
        assert "hold  q2 " in line
        assert "coils +100.0 +0.0 +0.0 mA" in line
        assert "answered in" in line


def test_an_event_that_is_older_than_a_shown_event_is_shown_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A held-back event is recorded late with its earlier time, and a restart begins at time zero."""
    monkeypatch.setattr("ground.commands.station._PING_S", 0.05)
    listener, packer = Listener(tmp_path / "socket"), Packer()
    newer, older = (event(packer, events.IMU_SILENT, time, f"at {time}") for time in (5.7, 2.3))
    said = answer(True)
    listener.will_say(said + newer, said + newer + older, said + newer + older, b"x")
    lines = command("watch", tmp_path / "socket", "--patience", "0.2").stdout.splitlines()
    assert [line.split(": ")[1] for line in lines if "imu-silent" in line] == ["at 5.7", "at 2.3"]


def test_a_watch_ends_if_the_flight_no_longer_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ground.commands.station._PING_S", 0.05)
    listener = Listener(tmp_path / "socket")
    listener.will_say(answer(True), answer(True), b"x")
    done = command("watch", tmp_path / "socket", "--patience", "0.2")
    assert done.returncode == 1
    assert "  hold  answered in " in done.stdout
    assert done.stderr.endswith("no further answer\n")


def test_a_path_that_is_neither_a_run_nor_a_socket_is_refused(tmp_path: Path) -> None:
    done = command("watch", tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


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


def test_a_long_log_is_read_in_portions(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = (run / "flight-0001.ccsds").read_bytes()
    for number, begin in enumerate(range(0, len(data), 7000)):
        path = tmp_path / f"flight-{number + 1:04}.ccsds"
        path.write_bytes(data[begin : begin + 7000])
        os.utime(path, (time.time() - 500.0,) * 2)
    monkeypatch.setattr(watch, "_PORTION", 5000)
    tail = LogTail(tmp_path)
    counts: list[int] = []
    while tail.behind or not counts:
        counts.append(sum(map(len, tail.new().values())))
        assert tail.behind == (tail.silence < 100.0)
    assert sum(counts) == sum(read_run(run).flight.counts.values())
    assert len(counts) > 2
    assert not tail.problem
    monkeypatch.setattr(station, "_READ_S", 0.0)
    for once in (True, False):
        options = argparse.Namespace(once=once, json=False, link=None, plain=True, every=1.0, patience=60.0)
        assert station._watch(options, LogTail(tmp_path), 0.0, "") == (0 if once else 1)
        assert "6.000 s" in capsys.readouterr().out, "the whole log was read"


def test_an_error_of_the_disk_loses_no_packet(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = (run / "flight-0001.ccsds").read_bytes()
    (tmp_path / "flight-0001.ccsds").write_bytes(data[:5000])
    (tmp_path / "flight-0002.ccsds").write_bytes(data[5000:])
    tail, segments = LogTail(tmp_path), tmp_path / "flight-0002.ccsds"
    with monkeypatch.context() as patch:
        opened = Path.open

        def failing(path: Path, *arguments: Any) -> Any:
            if path == segments:
                raise OSError(errno.EIO, "Input/output error")
            return opened(path, *arguments)

        patch.setattr(Path, "open", failing)
        with pytest.raises(UsageError, match="cannot be read"):
            tail.new()
    assert sum(map(len, tail.new().values())) == sum(read_run(run).flight.counts.values())
    assert not tail.problem


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


class Portions:
    """A feed whose packets arrive in portions, as over a link."""

    silence = 0.0
    restarts = 0
    behind = False

    def __init__(self, *portions: bytes) -> None:
        self.left = list(portions)

    def new(self) -> dict[str, PacketArray]:
        return scan(self.left.pop(0) if self.left else b"").packets


def test_the_line_of_state_names_the_active_alarms(capsys: pytest.CaptureFixture[str]) -> None:
    held = sum(1 << bit for bit, name in FACTS if name in {"gyro-lost", "camera-late"})
    packets = (pack(Packer(), HEALTH, 5.0, mode=3, facts=held), pack(Packer(), ATTITUDE, 5.1, mode=3))
    names = [name for bit, name in FACTS if held >> bit & 1]
    assert len(names) == 2
    for as_json in (False, True):
        options = argparse.Namespace(once=True, json=as_json, link="127.0.0.1:5010")
        assert station._watch(options, Portions(*packets), 0.0, "over the link") == 0
        shown = capsys.readouterr().out
        assert json.loads(shown)["alarms"] == names if as_json else f"alarms {', '.join(names)}" in shown


def test_a_link_without_a_flight_has_no_state(capsys: pytest.CaptureFixture[str]) -> None:
    options = argparse.Namespace(once=True, json=False, link="127.0.0.1:5010")
    only_the_link = pack(Packer(), LINK, 5.0)
    assert station._watch(options, Portions(only_the_link), 0.0, "over the link") == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "the link answers, but the flight does not run" in shown.err
    assert station._watch(options, Portions(), 0.0, "over the link") == 1
    assert "no frame is authentic: check --link, --keys and --spacecraft" in capsys.readouterr().err


def test_a_watch_ends_if_only_the_link_sends_packets(capsys: pytest.CaptureFixture[str]) -> None:
    options = argparse.Namespace(
        once=False, json=False, link="127.0.0.1:5010", every=10.0, patience=0.3, plain=True
    )
    only_the_link = [pack(Packer(), LINK, 5.0 + k) for k in range(40)]
    assert station._watch(options, Portions(*only_the_link), 0.0, "over the link") == 1
    assert "s over the link: the link answers, but the flight does not run" in capsys.readouterr().err


def test_failed_commands_of_a_link_are_shown() -> None:
    lines: list[str] = []
    reports = b"".join(
        pack(Packer(), VERIFICATION, 7.0, stage=int(stage), name="schedule", text=stage.name)
        for stage in Stage
    )
    PlainLines(FlightState(), 10.0, lines.append).feed(scan(reports).packets)
    assert [line for line in lines if "schedule" in line] == [
        "    7.000 s  warning  schedule refused: REFUSED\n",
        "    7.000 s  warning  schedule failed: FAILED\n",
    ]


def test_a_flight_that_restarts_is_shown_from_its_start_on() -> None:
    lines: list[str] = []
    shown, packer = PlainLines(FlightState(), 1.0, lines.append), Packer()
    before = [pack(packer, HEALTH, 100.0 + k, mode=3) for k in range(2)]
    after = [pack(packer, HEALTH, 0.5 + k, mode=1) for k in range(2)]
    late = event(packer, events.IMU_SILENT, 97.0, "held back")
    for data in (*before, before[0], late, *after):
        shown.feed(scan(data).packets)
    states = [line.split()[0] for line in lines if "alarms" in line]
    assert states == ["100.000", "101.000", "0.500", "1.500"]
    assert lines[-1].endswith("faults received 0 since 0.5 s\n")


def test_faults_that_were_not_recorded_are_counted() -> None:
    state, fault = FlightState(), int(events.Severity.FAULT)
    state.update(scan(pack(Packer(), EVENT, 5.0, severity=fault, name="imu-silent", suppressed=4)).packets)
    assert state.faults == 5


def test_one_look_over_a_link_waits_for_a_complete_state(capsys: pytest.CaptureFixture[str]) -> None:
    packer = Packer()
    health, attitude = pack(packer, HEALTH, 5.0, mode=3, slips=4), pack(packer, ATTITUDE, 5.1, mode=3)
    options = argparse.Namespace(once=True, json=False, link="127.0.0.1:5010")
    assert station._watch(options, Portions(b"", health, attitude), 20.0, "over the link") == 0
    shown = capsys.readouterr().out
    assert "5.100 s" in shown
    assert shown.endswith("slips 4  alarms none  faults received 0 since 5.0 s\n")  # earlier ones are unknown
    assert station._watch(options, Portions(), 0.01, "over the link") == 1
    assert "no state of the flight in 0.01 s over the link" in capsys.readouterr().err


def test_the_line_of_an_event_counts_the_events_before_it_that_were_not_recorded() -> None:
    plain = LoggedEvent(5.7, 2, "gps-refused", "60 m off")
    assert event_line(plain).endswith("gps-refused: 60 m off")
    many = LoggedEvent(5.7, 2, "gps-refused", "60 m off", 4)
    assert event_line(many).endswith("gps-refused: 60 m off (4 before it not recorded)")
