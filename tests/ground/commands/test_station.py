"""Tests of ground station commands: keys, `watch`, and the addresses of console and gateway."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from flight.link import events
from flight.link.events import Mode
from flight.link.telemetry.definitions import CONTROL, EVENT, HEALTH, MODE, Packet
from flight.link.telemetry.packets import Packer
from ground.commands import station
from ground.telemetry import decode
from knightcube.errors import UsageError
from tests.ground.commands.in_process import command


def packed(packer: Packer, packet: Packet, time: float, **values: Any) -> bytes:
    """Return a packet whose values are zero or empty, except for the given values."""
    plain: dict[str, Any] = {}
    for field in packet.fields:
        zero: Any = "" if field.kind.startswith("S") else 0
        plain[field.name] = [zero] * field.count if field.count > 1 else zero
    return packer.pack(packet, round(time * 1e9), {**plain, **values})


def flight_log(folder: Path, stopped: bool = True) -> Path:
    """Write the log of a short flight."""
    packer = Packer()
    kinds = [events.STARTED, events.IMU_SILENT, *([events.STOPPED] if stopped else [])]
    raw = packed(packer, MODE, 0.5, mode=int(Mode.HOLD))
    raw += packed(packer, HEALTH, 1.0, imu=1, mode=int(Mode.HOLD))
    for k in range(4):
        raw += packed(packer, CONTROL, 1.0 + k, cycle=k, current_written=[0.01, float("nan"), -0.02])
    for k, kind in enumerate(kinds):
        severity = int(kind.severity)
        raw += packed(
            packer, EVENT, 2.0 + k, code=kind.code, name=kind.name, severity=severity, text=f"text {k}"
        )
    folder.mkdir()
    (folder / "flight-0001.ccsds").write_bytes(raw)
    return folder


def test_the_present_state_is_printed_once(tmp_path: Path) -> None:
    run = flight_log(tmp_path / "run")
    done = command("watch", run, "--once")
    assert (done.returncode, done.stdout.count("\n")) == (0, 1)
    assert "hold" in done.stdout
    assert "  ended: " in done.stdout
    killed = flight_log(tmp_path / "live", stopped=False)
    assert "ended" not in command("watch", killed, "--once").stdout
    os.utime(killed / "flight-0001.ccsds", (1.0e9, 1.0e9))
    assert "no packet for " in command("watch", killed, "--once").stdout
    assert json.loads(command("watch", killed, "--json").stdout)["silence_s"] > 1e6


def test_the_present_state_as_json(tmp_path: Path) -> None:
    facts = json.loads(command("watch", flight_log(tmp_path / "run"), "--json").stdout)
    assert (facts["mission_time_s"], facts["mode"], facts["ended"]) == (4.0, "hold", "text 2")
    assert facts["currents_a"] == [0.01, None, -0.02]
    assert [(event["time_s"], event["name"], event["text"]) for event in facts["events"]] == [
        (2.0, "started", "text 0"),
        (3.0, "imu-silent", "text 1"),
        (4.0, "stopped", "text 2"),
    ]
    assert set(facts["streams"]) == {"imu", "field", "coils", "power", "camera"}
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "flight-0001.ccsds").write_bytes(packed(Packer(), MODE, 0.5, mode=int(Mode.SAFE)))
    nothing = json.loads(command("watch", bare, "--json").stdout)
    assert (nothing["currents_a"], nothing["streams"], nothing["ended"], nothing["attitude"]) == (None,) * 4


def test_a_watch_ends_with_the_flight_or_fails_when_its_log_stops_growing(tmp_path: Path) -> None:
    done = command("watch", flight_log(tmp_path / "run"), "--plain")
    assert done.returncode == 0
    assert "imu-silent" in done.stdout
    silent = command("watch", flight_log(tmp_path / "live", stopped=False), "--plain", "--patience", "1e-6")
    assert silent.returncode == 1
    assert "no new packet" in silent.stderr


def answer(count: int) -> Any:
    """Return a reply of a flight to a ping."""
    packer = Packer()
    raw = packed(packer, MODE, 0.5, mode=int(Mode.HOLD)) + packed(
        packer, EVENT, 1.0, name="started", text="now"
    )
    return SimpleNamespace(packets=decode(raw), count=count, delay=0.0125)


def test_a_flight_is_asked_over_its_socket(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, float]] = []

    def answers(to: str, patience: float, _: Any) -> Iterator[Any]:
        asked.append((to, patience))
        yield from (answer(k) for k in (3, 4))

    monkeypatch.setattr(station, "answers", answers)
    monkeypatch.setattr(station, "_PING_S", 0.0)
    once = command("watch", "127.0.0.1:9", "--once", "--patience", "5")
    assert (once.returncode, asked) == (0, [("127.0.0.1:9", 5.0)])
    assert once.stdout.splitlines()[-1].endswith("answered in 12.5 ms")
    assert "started" in once.stdout
    facts = json.loads(command("watch", "127.0.0.1:9", "--json").stdout)
    assert (facts["commands"], facts["answered_s"], facts["mode"]) == (3, 0.0125, "hold")
    both = command("watch", "127.0.0.1:9")
    assert both.returncode == 1
    assert both.stdout.count("answered in") == 2
    assert "no further answer" in both.stderr
    monkeypatch.setattr(station, "answers", lambda *_: iter(()))
    none = command("watch", "127.0.0.1:9")
    assert none.returncode == 1
    assert none.stderr.endswith(": no answer\n")


@pytest.mark.parametrize(
    ("to", "complaint"),
    [
        ("flight-0001.ccsds", "is not a socket: give the command socket of a flight"),
        ("127.0.0.1:99999", "port 99999: give a port from 1 to 65535"),
        ("127.0.0.1:0", "port 0: give a port from 1 to 65535"),
    ],
)
def test_an_address_of_no_flight_is_refused(tmp_path: Path, to: str, complaint: str) -> None:
    run = flight_log(tmp_path / "run")
    address = str(run / to) if to.startswith("flight") else to
    for words in (("console", run, "--to", address), ("command", "--to", address, "ping")):
        done = command(*words)
        assert done.returncode == 2
        assert complaint in done.stderr


def test_a_configuration_of_a_link_is_not_ignored_for_a_run(tmp_path: Path) -> None:
    done = command("console", flight_log(tmp_path / "run"), "--config", "orbit")
    assert done.returncode == 2
    assert "orbit.yaml: is for --link; a run has its own configuration" in done.stderr


def test_keys_are_made_for_both_ends(tmp_path: Path) -> None:
    done = command("keys", tmp_path / "keys")
    assert done.returncode == 0
    assert [line.rpartition(": ")[2] for line in done.stdout.splitlines()] == [
        str(tmp_path / "keys" / "satellite"),
        str(tmp_path / "keys" / "ground"),
    ]


def test_a_gateway_serves_until_a_signal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made: list[Any] = []
    closed: list[str] = []

    class FakeGateway:
        port = 4321

        def __init__(self, terminal: Any, address: str, token: str, say: Any) -> None:
            made.append((address, token))
            say("hello")

        def run(self, ended: Any) -> None:
            assert not ended()
            assert (tmp_path / "gateway-4321.token").read_text().strip() == made[0][1]

        def close(self) -> None:
            closed.append("gateway")

    monkeypatch.setattr(station, "Gateway", FakeGateway)
    terminal = SimpleNamespace(close=lambda: closed.append("terminal"), reception=lambda: "7 frames accepted")
    monkeypatch.setattr(station, "terminal_of", lambda _: terminal)
    done = command("gateway", "--link", "127.0.0.1:9", "--keys", tmp_path, "--serve", "127.0.0.1:0")
    assert done.stdout.endswith("7 frames accepted\n")
    assert (done.returncode, done.stderr) == (0, "knightcube: gateway: hello\n")
    assert "127.0.0.1:4321" in done.stdout
    assert made[0][0] == "127.0.0.1:0"
    assert closed == ["gateway", "terminal"]
    assert not (tmp_path / "gateway-4321.token").exists()


@pytest.mark.parametrize("port", [-1, 65536])
def test_a_port_is_a_number_of_16_bits(port: int) -> None:
    with pytest.raises(UsageError, match=str(port)):
        station._listening(port)


def test_the_page_listens_on_loopback_only() -> None:
    with station._listening(0) as line:
        address, port = line.getsockname()
        assert address == "127.0.0.1"
        assert line.getsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR)
        line.listen()
        with pytest.raises(UsageError, match=str(port)):
            station._listening(port)


@contextmanager
def _served(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """Keep the console instead of starting its server."""
    web = pytest.importorskip("aiohttp.web")
    served: list[Any] = []
    monkeypatch.setattr(web, "run_app", lambda app, **options: served.append((app, options)))
    yield served


def test_a_console_prints_the_address_of_its_page(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    opened: list[str] = []
    monkeypatch.setattr("ground.commands.station.webbrowser.open", opened.append)
    with _served(monkeypatch) as served:
        run = flight_log(tmp_path / "run")
        done = command("console", run, "--port", "0")
        assert done.returncode == 0, done.stderr
        assert "console of run" in done.stdout
        assert "/?token=" in done.stdout
        assert len(served) == 1
        assert served[0][1]["print"] is served[0][1]["access_log"] is None
        assert opened == []
        opening = command("console", run, "--port", "0", "--open")
        assert opened[0] in opening.stdout


def test_a_console_needs_a_run_or_a_link() -> None:
    for words in ((), ("run", "--link", "127.0.0.1:9")):
        done = command("console", *words)
        assert done.returncode == 2
        assert "--link" in done.stderr
