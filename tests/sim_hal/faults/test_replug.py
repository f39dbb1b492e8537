"""Tests that an unplugged serial adapter is opened again under its persistent name."""

from __future__ import annotations

import os
import threading
import time
import tty
from pathlib import Path

import pytest

from hal.buses.linux_wires import PySerialPort
from hal.buses.system import SystemClock
from hal.interfaces.errors import NotResponding


def plug_in(link: Path) -> tuple[int, int]:
    """Make a pseudo-terminal with a persistent name, as udev does."""
    near, far = os.openpty()
    tty.setraw(far)
    link.unlink(missing_ok=True)
    link.symlink_to(os.ttyname(far))
    return near, far


def pull_out(ends: tuple[int, int]) -> None:
    for end in ends:
        os.close(end)


def receive(port: PySerialPort, patience: float = 3.0) -> bytes:
    """Return the next bytes of the port. Earlier errors of the port are ignored."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        try:
            chunks = port.receive()
        except NotResponding:
            chunks = []
        if chunks:
            return b"".join(data for _, data in chunks)
        time.sleep(0.01)
    return b""


def test_the_port_is_open_again_within_two_seconds(tmp_path: Path) -> None:
    link = tmp_path / "imu"
    ends = plug_in(link)
    port = PySerialPort(str(link), 115200, SystemClock())
    try:
        os.write(ends[0], b"before")
        assert receive(port) == b"before"
        pull_out(ends)
        time.sleep(0.3)
        with pytest.raises(NotResponding, match="still there"):
            port.receive()
        with pytest.raises(NotResponding):
            port.send(b"lost")
        ends = plug_in(link)
        begun = time.monotonic()
        found = b""
        while not found and time.monotonic() - begun < 3.0:
            os.write(ends[0], b"after")  # bytes that arrive before the port is open are discarded
            found = receive(port, 0.05)
        assert found.startswith(b"after")
        assert time.monotonic() - begun < 2.0
        port.send(b"reply")
        assert os.read(ends[0], 16) == b"reply"
        pull_out(ends)
    finally:
        port.close()


def test_a_port_that_is_gone_for_good_can_be_closed(tmp_path: Path) -> None:
    link = tmp_path / "imu"
    ends = plug_in(link)
    port = PySerialPort(str(link), 115200, SystemClock())
    pull_out(ends)
    link.unlink()
    time.sleep(0.3)
    begun = time.monotonic()
    port.close()
    assert time.monotonic() - begun < 1.0


def test_a_port_that_vanishes_is_not_closed_while_data_are_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = tmp_path / "imu"
    ends = plug_in(link)
    port = PySerialPort(str(link), 115200, SystemClock())
    open_meanwhile = []

    def vanish(data: bytes) -> int:
        pull_out(ends)
        time.sleep(0.1)  # time in which the receiving thread detects that the port is lost
        open_meanwhile.append(port._serial.is_open)
        return len(data)

    monkeypatch.setattr(port, "_write", vanish)
    port.send(b"data")
    port.close()
    assert open_meanwhile == [True]


def test_a_port_can_be_closed_while_the_thread_gives_up_the_lost_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = tmp_path / "imu"
    ends = plug_in(link)
    port = PySerialPort(str(link), 115200, SystemClock())
    begun, ended = threading.Event(), threading.Event()
    close, cancel_read = port._serial.close, port._serial.cancel_read

    def close_slowly() -> None:
        begun.set()
        time.sleep(0.1)
        close()
        ended.set()

    def cancel() -> None:
        assert ended.is_set()
        cancel_read()

    monkeypatch.setattr(port._serial, "close", close_slowly)
    monkeypatch.setattr(port._serial, "cancel_read", cancel)
    pull_out(ends)
    assert begun.wait(3.0)
    port.close()
