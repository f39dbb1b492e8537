"""Tests that the safe-state unit zeroes the coils, answers commands, and restarts the flight process."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from flight.link.commands import LAYOUTS as COMMANDS
from flight.link.commands import ChangeMode, Clear, Command, CommandPacker, Ping, Slew
from flight.link.events import Mode
from flight.link.telemetry.definitions import COMMAND
from flight.link.telemetry.packets import LAYOUTS, to_text
from ground.link.commanding import exchange
from ground.telemetry import decode
from tests.deploy.scripts import DEPLOY, script

safe_state = script("safe_state")


def packed(command: Command, number: int = 1) -> bytes:
    return CommandPacker().pack(command, number)


def test_packets_of_the_safe_state_agree_with_the_tables() -> None:
    assert {layout.identifier: name for name, layout in COMMANDS.items()} == safe_state.COMMANDS
    assert {name: layout.length for name, layout in COMMANDS.items()} == safe_state.LENGTHS
    layout = LAYOUTS[COMMAND.name]
    assert layout.body.format.replace("1B", "B").replace("1I", "I") == safe_state.ANSWER
    assert (layout.identifier, COMMAND.version) == (safe_state.ANSWER_ID, safe_state.ANSWER_VERSION)
    assert int(Mode.SAFE) == safe_state.SAFE_MODE


@pytest.mark.parametrize(
    ("command", "obeyed", "due", "text"),
    [
        (Ping(7), 1, 130.0, "ping: safe state, start 1 of the flight software in 20 s"),
        (ChangeMode(Mode.HOLD), 1, 110.0, "mode: safe state, start 1 of the flight software in 0 s"),
        (ChangeMode(Mode.SAFE), 1, 3710.0, "safe: safe state, start 1 of the flight software in 3600 s"),
        (Slew(0.1), 0, 130.0, "the board is in its safe state and executes only ping, safe and mode"),
        (Clear("too-hot"), 0, 130.0, "the board is in its safe state and executes only ping, safe and mode"),
    ],
)
def test_a_command_is_answered_once_and_mode_tries_the_flight(
    tmp_path: Path, command: Command, obeyed: int, due: float, text: str
) -> None:
    state = safe_state.SafeState(safe_state.Tries(str(tmp_path), 100.0), 100.0)
    (row,) = decode(state.answer(packed(command), 110.0))["command"]
    assert (row["obeyed"], row["mode"], row["count"]) == (obeyed, Mode.SAFE, 1)
    assert to_text(row["text"]) == text
    assert state.due == due
    (row,) = decode(state.answer(packed(command), 115.0))["command"]
    assert to_text(row["text"]) == "an identical packet was received before"
    assert state.due == due


def test_only_commands_are_answered(tmp_path: Path) -> None:
    state = safe_state.SafeState(safe_state.Tries(str(tmp_path), 0.0), 0.0)
    ping = packed(Ping(7))
    answer = state.answer(ping, 1.0)
    damaged = [bytes([*ping[:i], ping[i] ^ 4, *ping[i + 1 :]]) for i in range(len(ping))]
    assert [data for data in (b"", ping[:-1], ping + b"x", answer, *damaged) if state.answer(data, 1.0)] == []


def test_the_pause_doubles_with_each_try_until_a_flight_has_lasted_long_enough(tmp_path: Path) -> None:
    now, found = 0.0, []
    for _ in range(9):
        tries = safe_state.Tries(str(tmp_path), now)
        found.append(tries.pause(tries.number))
        now += found[-1]
        tries.keep(now)
        now += 60.0
    assert found == [30.0, 60.0, 120.0, 240.0, 480.0, 960.0, 1920.0, 3600.0, 3600.0]
    assert safe_state.Tries(str(tmp_path), now + 5000.0).number == 1
    (tmp_path / "tries").write_bytes(b"\xff torn")
    assert safe_state.Tries(str(tmp_path), now).number == 1


def test_the_process_zeroes_the_coils_answers_and_ends_when_the_flight_is_to_be_tried(tmp_path: Path) -> None:
    shutil.copy(DEPLOY / "safe_state.py", tmp_path)
    off = tmp_path / "coils-off"
    off.write_text(f'#!/bin/sh\necho off >>"{tmp_path}/calls"\n', encoding="ascii")
    off.chmod(0o755)
    place = tmp_path / "commands"
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", str(tmp_path / "safe_state.py")],
        env={**os.environ, "KNIGHTCUBE_COMMANDS": str(place), "RUNTIME_DIRECTORY": str(tmp_path)},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        deadline = time.monotonic() + 300.0
        while not place.is_socket() and time.monotonic() < deadline:
            time.sleep(0.01)
        (row,) = decode(exchange(str(place), packed(Ping(), time.time_ns()), 10.0))["command"]
        assert row["obeyed"] == 1
        exchange(str(place), packed(ChangeMode(Mode.HOLD), time.time_ns()), 10.0)
        said = process.communicate(timeout=20.0)[1]
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert process.returncode == 0
    assert (tmp_path / "calls").read_text(encoding="ascii") == "off\n"
    assert "start number 1 follows in 30 s" in said
    assert "coils at zero" in said
    assert "the flight software is started again, start 1" in said
    assert (tmp_path / "tries").read_text(encoding="ascii").startswith("1 ")


def test_a_hanging_script_is_killed_with_its_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    off, child = tmp_path / "coils-off", tmp_path / "child"
    off.write_text(f'#!/bin/sh\nsleep 1000 &\necho $! >"{child}.part"\nmv "{child}.part" "{child}"\nwait\n')
    off.chmod(0o755)
    monkeypatch.setattr(safe_state, "__file__", str(tmp_path / "safe_state.py"))
    wait = subprocess.Popen.wait

    def wait_for_child(process: subprocess.Popen[bytes], timeout: float | None = None) -> int:
        while not child.exists():
            time.sleep(0.01)
        return wait(process, None if timeout is None else 0.0)

    monkeypatch.setattr(subprocess.Popen, "wait", wait_for_child)
    assert not safe_state.coils_off()
    assert "did not end in 30 s" in capsys.readouterr().err
    number = int(child.read_text(encoding="ascii"))
    while (place := Path(f"/proc/{number}/stat")).exists() and place.read_text().split()[2] != "Z":
        time.sleep(0.01)


def test_a_journal_that_has_ended_does_not_end_the_safe_state(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: str) -> None:
        raise BrokenPipeError

    monkeypatch.setattr(sys, "stderr", SimpleNamespace(write=fail))
    safe_state.say("coils at zero")


def test_without_a_folder_no_try_is_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    safe_state.Tries("", 0.0).keep(1.0)
    assert list(tmp_path.iterdir()) == []
