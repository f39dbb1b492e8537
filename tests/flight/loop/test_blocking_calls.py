"""Tests that no call of the control thread waits for a disk, a device or another process."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

from flight.link.commands import DatagramChannel
from flight.link.files.store import make_lasting
from tests.hal.guardian.live_flight import ROOT, devices_running, write_config
from tests.support.blocking_calls import BlockingCalls

_LOCK = "a lock that its holder releases without a call of the operating system"
ALLOWED = {
    "hal/buses/system.py:SystemClock.sleep_until_ns": ("time.sleep", "waits for the next cycle, as intended"),
    "flight/link/commands.py:_identity": ("posix.lstat", "a file in /run, which is in memory"),
    "flight/loop/executive.py:ProcessRunner.submit": ("posix.eventfd_write", "does not block"),
    "hal/guardian.py:GuardianLine.beat": ("_socket.socket.send", "MSG_DONTWAIT"),
    "hal/guardian.py:GuardianLine._receive": ("_socket.socket.recv", "MSG_DONTWAIT"),
    "hal/buses/system.py:ThreadTicker.kick": ("_thread.", _LOCK),
    "flight/link/telemetry/packets.py:Packer.pack": ("_thread.", _LOCK),
    "hal/buses/linux_wires.py:PySerialPort.receive": ("_thread.", _LOCK),
    "hal/drivers/coils.py:CommandMailbox.put": ("_thread.", _LOCK),
    "hal/drivers/coils.py:CommandMailbox.withdraw": ("_thread.", _LOCK),
    "hal/drivers/coils.py:PwmTorqueCoils.command": ("_thread.", _LOCK),
    "hal/drivers/coils.py:PwmTorqueCoils.state": ("_thread.", _LOCK),
    "hal/drivers/current_monitors.py:PolledMonitor.error": ("_thread.", _LOCK),
    "hal/drivers/current_monitors.py:PolledMonitor.latest": ("_thread.", _LOCK),
}
"""Functions that may block the control thread, with the start of the blocking call's name and the reason."""


def test_the_control_thread_makes_only_the_permitted_waiting_calls() -> None:
    with tempfile.TemporaryDirectory(prefix="kc-") as name:  # the path of a UNIX socket must be short
        place = Path(name)
        (place / "devices").mkdir()
        config = write_config(place)
        with config.open("a", encoding="utf-8") as file:
            file.write(
                f"\ncommands: {{socket: {place / 'commands'}}}\nstate: {{folder: {place / 'state'}}}\n"
            )
        with devices_running(place / "devices") as devices:
            words = ["-m", "tests.support.blocking_calls", str(config), str(place / "run"), str(devices)]
            done = subprocess.run(
                [sys.executable, *words], cwd=ROOT, capture_output=True, text=True, check=True
            )
    found = [tuple(one) for one in json.loads(done.stdout.splitlines()[-1])]
    assert ("hal/buses/system.py:SystemClock.sleep_until_ns", "time.sleep") in found, "nothing was watched"
    refused = [one for one in found if not one[1].startswith(ALLOWED.get(one[0], ("none",))[0])]
    assert refused == []


def test_a_call_that_waits_for_the_disk_or_a_socket_is_found(tmp_path: Path) -> None:
    calls, line = BlockingCalls(), socket.socketpair()
    channel = DatagramChannel("udp", line[0])
    line[0].setblocking(True)
    line[1].send(b"x")
    line[1].close()
    calls.start()
    make_lasting(tmp_path)
    channel.poll()
    calls.stop()
    channel.close()
    assert ("flight/link/files/store.py:make_lasting", "posix.fsync") in calls.found
    assert ("flight/link/commands.py:DatagramChannel.poll", "_socket.socket.recvfrom") in calls.found


def test_a_socket_that_does_not_block_is_left_out() -> None:
    calls, line = BlockingCalls(), socket.socketpair()
    channel = DatagramChannel("udp", line[0])
    calls.start()
    channel.poll()
    calls.stop()
    channel.close()
    line[1].close()
    assert not any("recvfrom" in name for _, name in calls.found)
