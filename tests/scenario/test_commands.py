"""Tests that each command in flight is executed or refused, with an event and a reply."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.link.commands import ChangeMode, Clear, Command, CommandPacker, Ping, Slew
from flight.link.events import Mode
from flight.link.telemetry.packets import to_text
from ground.telemetry import decode
from tests.scenario.answers import said
from tests.scenario.mode_flights import modes_of
from tests.support.flights import demo_config, event_names, fly


def packed(*commands: Command) -> list[bytes]:
    packer = CommandPacker()
    return [packer.pack(command, k) for k, command in enumerate(commands)]


def test_each_command_is_obeyed_recorded_and_answered(tmp_path: Path) -> None:
    ping, hold, slew, safe = packed(
        Ping(7), ChangeMode(Mode.HOLD), Slew(0.1), ChangeMode(Mode.SAFE, "enough")
    )
    run, channel = said(tmp_path, (1.0, ping), (1.5, hold), (2.0, slew), (3.0, safe))
    assert modes_of(run)[2:] == [Mode.HOLD, Mode.SLEW, Mode.SAFE]
    rows = run["command"]
    assert rows["obeyed"].tolist() == [1, 1, 1, 1]
    assert [to_text(text) for text in rows["text"]] == [
        "ping 7",
        "mode hold",
        "slew to q2 +0.1000",
        "mode safe: enough",
    ]
    answers = np.concatenate([decode(answer)["command"] for answer in channel.answers])
    assert answers["count"].tolist() == [1, 2, 3, 4]
    assert answers["mode"].tolist() == [Mode.TESTBED_DEMO, Mode.HOLD, Mode.SLEW, Mode.SAFE]
    status = decode(channel.answers[0])
    for name in ("run", "control", "attitude", "health"):
        (row,) = status[name]
        assert row.tobytes() in {logged.tobytes() for logged in run[name]}, name
        assert 0.9 < row["time_ns"] * 1e-9 <= 1.0 or name in ("run", "health")
    names = [to_text(name) for name in status["event"]["name"]]
    assert 0 < len(names) <= 2
    assert "commanded" not in names
    assert len(channel.answers[0]) <= 1472, "a UDP datagram in one Ethernet frame"
    assert [len(decode(answer)["control"]) for answer in channel.answers[1:]] == [0, 0, 0]
    assert event_names(run).count("commanded") == 2, "reported at once, the others at the end: throttled"


def test_invalid_and_repeated_packets_are_refused_with_the_reason_and_change_nothing(tmp_path: Path) -> None:
    (hold,) = packed(ChangeMode(Mode.HOLD))
    broken = bytes([*hold[:-1], hold[-1] ^ 1])
    run, channel = said(tmp_path, (1.0, b"abort!"), (1.2, broken), (1.4, b""), (1.6, hold), (2.0, hold))
    rows = run["command"]
    assert rows["obeyed"].tolist() == [0, 0, 0, 1, 0]
    reasons = [to_text(text) for text in rows["text"]]
    assert "no command begins with" in reasons[0]
    assert "CRC" in reasons[1]
    assert "0 bytes are too short for a packet" in reasons[2]
    assert "an identical packet was received before" in reasons[4]
    assert modes_of(run)[2:] == [Mode.HOLD]
    assert len(channel.answers) == 2, "only commands are answered"
    assert "command-socket" in event_names(run)
    assert "command-refused" in event_names(run)
    assert "task-failed" not in event_names(run)


def test_control_characters_are_shown_escaped(tmp_path: Path) -> None:
    (safe,) = packed(ChangeMode(Mode.SAFE, "smoke\x1b[2J\n"))
    run, _ = said(tmp_path, (1.0, safe))
    assert to_text(run["command"][0]["text"]) == "mode safe: smoke\\x1b[2J\\n"


def test_a_clear_command_for_an_event_that_is_not_latched_is_refused(tmp_path: Path) -> None:
    (clear,) = packed(Clear("too-hot"))
    run, _ = said(tmp_path, (1.0, clear))
    (row,) = run["command"]
    assert to_text(row["text"]) == "clear too-hot: no event is latched as 'too-hot'; latched: nothing"


def test_a_defect_of_a_command_is_contained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fall(*_: object) -> str:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr("flight.loop.modes.ModeControl.command", fall)
    (hold,) = packed(ChangeMode(Mode.HOLD))
    run, _ = said(tmp_path, (1.0, hold))
    (row,) = run["command"]
    assert to_text(row["text"]) == "mode hold: ZeroDivisionError: a defect"
    assert "task-failed" not in event_names(run)


def test_without_configured_commands_no_rate_group_runs_for_them(tmp_path: Path) -> None:
    run = fly(demo_config(1.5, camera=False), tmp_path)
    groups = {to_text(name) for name in run["rate_group"]["name"]}
    assert groups == {"control", "planning", "health", "housekeeping"}
