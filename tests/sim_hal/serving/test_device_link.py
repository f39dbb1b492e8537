"""Tests of the connection between a flight process and devices in another process."""

from __future__ import annotations

import errno
import json
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flight.app.flight import fly
from flight.app.run import RunRequest
from hal.buses.linux_wires import lock_bus
from hal.interfaces.errors import NotResponding
from knightcube.errors import UsageError
from sim_hal.serving.device_link import Inbox, RemoteI2cBus, open_bus, pack
from tests.support.flights import CONFIG

ROOT = CONFIG.parents[1]
_VALUES = st.recursive(st.integers() | st.text() | st.booleans(), lambda value: st.lists(value, max_size=4))


@given(st.lists(_VALUES, max_size=6), st.integers(1, 9))
def test_messages_are_complete_however_the_wire_divides_them(messages: list[Any], piece: int) -> None:
    wire = b"".join(map(pack, messages))
    inbox = Inbox()
    cut = [wire[at : at + piece] for at in range(0, len(wire), piece)]
    assert [message for chunk in cut for message in inbox.take(chunk)] == messages


Serve = Callable[[Callable[[list[Any]], list[Any]]], RemoteI2cBus]


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    """Return a server that answers requests with the messages of a function, and a bus connected to it."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(tmp_path / "devices.sock"))
    listener.listen()
    open_buses: list[RemoteI2cBus] = []

    def start(answer: Callable[[list[Any]], list[Any]]) -> RemoteI2cBus:
        def work() -> None:
            line, _ = listener.accept()
            inbox = Inbox()
            with line:
                while chunk := line.recv(4096):
                    for request in inbox.take(chunk):
                        line.sendall(b"".join(map(pack, answer(request))))

        threading.Thread(target=work, daemon=True).start()
        open_buses.append(open_bus(str(tmp_path / "devices.sock")))
        return open_buses[-1]

    yield start
    for bus in open_buses:
        bus.close()
    listener.close()


def test_an_error_on_the_emulated_bus_is_the_errno_of_the_kernel(serve: Serve) -> None:
    bus = serve(lambda request: [[request[0], "error", errno.EREMOTEIO, "no acknowledge"]])
    with pytest.raises(OSError, match="no acknowledge") as caught:
        bus.write_byte_data(0x40, 0xFD, 0x10)
    assert caught.value.errno == errno.EREMOTEIO


def test_a_request_that_the_server_refuses_is_an_error_of_the_bus(serve: Serve) -> None:
    bus = serve(lambda request: [[request[0], "refused", 0, "no emulated device is connected"]])
    with pytest.raises(OSError, match="no emulated device is connected"):
        bus.read_byte_data(0x40, 0)


def test_an_answer_that_came_too_late_is_not_accepted_for_the_next_request(serve: Serve) -> None:
    def answer(request: list[Any]) -> list[Any]:
        if request[0] == 1:
            return []
        return [[1, "done", 11, ""], [2, "done", 22, ""]]

    bus = serve(answer)
    with pytest.raises(TimeoutError):
        bus.read_byte_data(0x40, 0)
    assert bus.read_byte_data(0x40, 0) == 22


def test_the_module_of_the_guardian_imports_no_large_package() -> None:
    away = {"numpy", "msgspec", "yaml"}
    script = f"import sys, sim_hal.serving.device_link; print({away} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert done.stdout == "set()\n"


def test_devices_that_run_are_flown_in_real_time_only(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--realtime"):
        fly(RunRequest(CONFIG, tmp_path / "run", devices=tmp_path / "facts.json"))


def test_the_option_devices_is_refused_for_real_devices(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--devices"):
        fly(RunRequest(ROOT / "config/testbed.yaml", tmp_path / "run", devices=tmp_path / "facts.json"))


@pytest.mark.parametrize("facts", [None, "{", "[]", "{}"])
def test_a_file_that_describes_no_server_is_refused(tmp_path: Path, facts: str | None) -> None:
    path = tmp_path / "facts.json"
    if facts is not None:
        path.write_text(facts, encoding="utf-8")
    problem = r"cannot be read \(No such file" if facts is None else "describes no server: give a file"
    with pytest.raises(UsageError, match=rf"--devices .*facts\.json: {problem}"):
        fly(RunRequest(CONFIG, tmp_path / "run", realtime=True, devices=path))


def test_a_server_that_has_ended_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "facts.json"
    unit = {"lines": {"/dev/knightcube-imu": "/dev/ptmx"}, "coil_bus": "/dev/i2c-1", "camera": False}
    gone = {**unit, "socket": str(tmp_path / "gone"), "wide": [], "utc_offset_ns": None}
    path.write_text(json.dumps(gone), encoding="utf-8")
    request = RunRequest(CONFIG, tmp_path / "run", realtime=True, devices=path)
    with path.open(encoding="utf-8") as held:
        lock_bus(held.fileno())
        with pytest.raises(NotResponding, match="another flight drives the coils"):
            fly(request)
    with pytest.raises(NotResponding, match=r"ptmx|server"):
        fly(request)
