"""Tests of the emulator on a pseudo-terminal with pyserial."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import serial

from flight.schema.sections import CONTROL_RATE_HZ
from hal.buses import linux_wires
from hal.buses.linux_wires import LinuxWires, PySerialPort
from hal.buses.system import SystemClock
from hal.drivers.vn100 import Vn100
from hal.interfaces.devices import ImuReading
from hal.interfaces.errors import CorruptData, NotResponding, OutputFull
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.quaternion import angle_about_axis_y
from sim_hal.emulators.serial_line import PtyLine
from sim_hal.rig import ServedWires
from tests.hal.vn100.bench_line import MISSION

COMMAND = [sys.executable, "-m", "sim_hal", "emulate", "vn100"]


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    link = tmp_path / "vn100"
    process = subprocess.Popen(
        [*COMMAND, "--rate-deg-s", "3", "--json", "--link", str(link)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        facts = json.loads(process.stdout.readline())
        assert os.path.realpath(link) == facts["device"]
        yield str(link), process
    finally:
        process.terminate()
        process.communicate(timeout=60)
    assert not link.is_symlink()


def readings_of(count: int, driver: Vn100, clock: SystemClock) -> list[ImuReading]:
    """Return at least `count` readings, for which a busy machine may need up to a minute."""
    readings: list[ImuReading] = []
    end_ns = clock.now_ns() + 60 * SECOND_NS
    while len(readings) < count and clock.now_ns() < end_ns:
        clock.sleep_until_ns(clock.now_ns() + 5_000_000)
        readings += driver.poll()
    return readings


def test_the_driver_sets_the_unit_up_and_reads_at_40_hz(served: tuple[str, subprocess.Popen[str]]) -> None:
    name, process = served
    clock = SystemClock()
    port = PySerialPort(name, 115200, clock)
    driver = Vn100(port, clock, MISSION)
    driver.configure()
    readings = readings_of(60, driver, clock)
    driver.close()
    driver.close()
    with pytest.raises(NotResponding, match="closed"):
        driver.poll()
    assert len(readings) >= 60
    times = np.array([r.device_time_ns for r in readings])
    periods = np.diff(times) / 25_000_000
    assert np.median(periods) == 1.0
    assert (periods % 1.0 == 0.0).all()  # a busy machine loses whole messages
    angles = np.array([angle_about_axis_y(r.quaternion) for r in readings])
    slope = np.polyfit(times * 1e-9, angles, 1)[0]
    # 60 angles with an error of 2 mrad, over at least 1.5 s, determine the rate to 0.6 mrad/s.
    assert slope == pytest.approx(np.radians(3.0), abs=3e-3)
    assert driver.link().discarded_bytes < 200  # end of a message that was cut when the port was opened
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 0


def test_a_wrong_baud_rate_is_named_as_the_probable_cause(served: tuple[str, subprocess.Popen[str]]) -> None:
    clock = SystemClock()
    driver = Vn100(PySerialPort(served[0], 57600, clock), clock, MISSION)
    with pytest.raises(CorruptData, match="check the baud rate"):
        driver.configure()
    driver.close()


def test_the_port_is_exclusive(served: tuple[str, subprocess.Popen[str]]) -> None:
    clock = SystemClock()
    port = PySerialPort(served[0], 115200, clock)
    with pytest.raises(NotResponding, match="port free"):
        PySerialPort(served[0], 115200, clock)
    port.close()


def test_an_open_port_cannot_be_opened_again_until_the_driver_closes_it() -> None:
    near, far = os.openpty()
    port = PySerialPort(os.ttyname(far), 115200, SystemClock())
    driver = Vn100(port, SystemClock(), MISSION)
    with pytest.raises(NotResponding, match="port free"):
        PySerialPort(os.ttyname(far), 115200, SystemClock())
    driver.close()
    with pytest.raises(NotResponding, match="closed"):
        driver.poll()
    PySerialPort(os.ttyname(far), 57600, SystemClock()).close()
    os.close(near)
    os.close(far)


@pytest.fixture
def cable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cable]:
    """Yield a cable whose port is opened again within milliseconds."""
    monkeypatch.setattr(linux_wires, "_REOPEN_S", 0.005)
    cable = Cable(tmp_path / "imu")
    yield cable
    cable.port.close()
    for end in cable.second:
        os.close(end)


class Cable:
    """A serial port `port` whose device file can be unplugged, and plugged in again as a second device."""

    def __init__(self, name: Path) -> None:
        self.name, self.first, self.second = name, os.openpty(), os.openpty()
        name.symlink_to(os.ttyname(self.first[1]))
        self.port = PySerialPort(str(name), 115200, SystemClock())

    def unplug(self) -> None:
        self.name.unlink()
        for end in reversed(self.first):
            os.close(end)

    def plug(self) -> None:
        self.name.symlink_to(os.ttyname(self.second[1]))


@pytest.mark.parametrize("served", [False, True])
def test_a_port_that_its_driver_has_closed_is_opened_again(served: bool) -> None:
    """A probe closes the port before the flight opens it."""
    near, far = os.openpty()
    clock, name = SystemClock(), os.ttyname(far)
    with ExitStack() as stack:
        wires = (
            ServedWires(clock, Path(), {name: name}, "/dev/i2c-1", stack)
            if served
            else LinuxWires(clock, stack, "/dev/i2c-1")
        )
        first = wires.serial(name, 9600)
        assert wires.serial(name, 9600) is first, "an open port is not opened twice"
        first.close()
        again = wires.serial(name, 9600)
        os.write(near, b"again")
        received = b""
        while len(received) < 5:
            clock.sleep_until_ns(clock.now_ns() + 1_000_000)
            received += b"".join(data for _, data in again.receive())
        assert received == b"again"
    os.close(near)
    os.close(far)


def test_a_port_that_is_unplugged_and_plugged_in_again_receives_and_sends(cable: Cable) -> None:
    clock, port, second = SystemClock(), cable.port, cable.second
    assert port._thread.daemon, "a thread that waits must not keep the process alive"
    cable.unplug()
    words, plugged, sent, deadline_ns = b"", False, False, clock.now_ns() + 20_000_000_000
    while words != b"again" and clock.now_ns() < deadline_ns:
        try:
            words += b"".join(data for _, data in port.receive())
            # Data that arrive before the port is open again are discarded, so the test sends its data
            # afterwards.
            sent = sent or (plugged and os.write(second[0], b"again") > 0)
        except NotResponding:
            if not plugged:
                cable.plug()
            plugged = True
        clock.sleep_until_ns(clock.now_ns() + 1_000_000)
    assert words == b"again"
    port.send(b"answer")
    assert os.read(second[0], 100).endswith(b"answer")


def test_a_baud_rate_that_is_set_while_the_port_is_reopened_is_kept(
    cable: Cable, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, port = SystemClock(), cable.port
    opening, changed = threading.Event(), threading.Event()
    open_port = port._open

    def slowly() -> serial.Serial:
        opened = open_port()
        opening.set()
        assert changed.wait(10.0)
        return opened

    monkeypatch.setattr(port, "_open", slowly)
    cable.unplug()
    cable.plug()
    assert opening.wait(10.0)
    port.set_baud_rate(57600)
    changed.set()
    deadline_ns = clock.now_ns() + 10_000_000_000
    while port._failure and clock.now_ns() < deadline_ns:
        clock.sleep_until_ns(clock.now_ns() + 1_000_000)
    assert port._failure == ""
    assert termios.tcgetattr(cable.second[1])[4:6] == [termios.B57600, termios.B57600]


def test_data_that_nobody_receives_are_dropped_oldest_first_and_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(linux_wires, "_PENDING_LIMIT", 10)
    near, far = os.openpty()
    port = PySerialPort(os.ttyname(far), 115200, SystemClock())
    port.close()
    port._keep(1, b"abcd")
    port._keep(2, b"efghij")
    assert port.lost_bytes == 0
    port._keep(3, b"kl")
    assert port.lost_bytes == 4
    assert port.receive() == [(2, b"efghij"), (3, b"kl")]
    port._keep(4, b"mnopqrstuv")
    assert (port.lost_bytes, port.receive()) == (4, [(4, b"mnopqrstuv")])
    os.close(near)
    os.close(far)


def test_closing_ends_the_thread_that_waits_for_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(linux_wires, "_READ_TIMEOUT_S", 60.0)
    near, far = os.openpty()
    port = PySerialPort(os.ttyname(far), 115200, SystemClock())
    port.close()
    assert not port._thread.is_alive()
    os.close(near)
    os.close(far)


def test_a_port_that_is_not_there_is_named() -> None:
    text = r"/dev/no-such-port: cannot be opened at 115200 baud \(No such file or directory\): "
    with pytest.raises(NotResponding, match=text):
        PySerialPort("/dev/no-such-port", 115200, SystemClock())


def test_a_port_that_may_be_missing_is_used_when_it_appears(tmp_path: Path) -> None:
    clock, name = SystemClock(), tmp_path / "imu"
    port = PySerialPort(str(name), 115200, clock, patient=True)
    with pytest.raises(NotResponding, match=f"{name}: cannot be opened at 115200 baud"):
        port.receive()
    with pytest.raises(NotResponding):
        port.send(b"?")
    near, far = os.openpty()
    name.symlink_to(os.ttyname(far))
    deadline_ns, sent, words = clock.now_ns() + 3_000_000_000, False, b""
    while words != b"first words" and clock.now_ns() < deadline_ns:
        clock.sleep_until_ns(clock.now_ns() + 5_000_000)
        with suppress(NotResponding):
            words += b"".join(data for _, data in port.receive())
            sent = sent or os.write(near, b"first words") > 0
    assert words == b"first words"
    port.close()
    os.close(near)
    os.close(far)


def test_a_port_that_takes_no_bytes_costs_less_than_a_control_cycle_and_is_not_responding() -> None:
    near, far = os.openpty()
    port = PySerialPort(os.ttyname(far), 115200, SystemClock())
    assert port._write_timeout < 1.0 / CONTROL_RATE_HZ
    with pytest.raises(OutputFull, match="the output queue is full") as full:
        port.send(bytes(1 << 20))  # no process reads the other end at this time
    read = 0
    os.set_blocking(near, False)
    with suppress(BlockingIOError):
        while True:
            read += len(os.read(near, 1 << 20))
    assert 0 < full.value.written == read
    os.close(near)
    port.close()
    os.close(far)


def test_a_port_that_its_thread_closes_slowly_is_not_waited_for(
    cable: Cable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel waits up to 30 s for the output queue of a serial port that is closed."""
    monkeypatch.setattr(linux_wires, "_CLOSE_S", 0.01)
    port, closing, may_close, closed = cable.port, *(threading.Event() for _ in range(3))
    close = port._serial.close

    def slowly() -> None:
        closing.set()
        may_close.wait(10.0)
        closed.set()
        close()

    monkeypatch.setattr(port._serial, "close", slowly)
    cable.unplug()
    assert closing.wait(10.0)
    port._failure = ""  # the loss was not yet known when the caller checked it
    for call in (partial(port.send, b"?"), partial(port.set_baud_rate, 57600)):
        with pytest.raises(NotResponding, match="is being closed"):
            call()
    assert port.baud_rate == 57600
    port.close()
    assert not closed.is_set()
    may_close.set()
    port._thread.join()
    assert closed.is_set()


class InterruptedClock(SystemClock):
    """A clock that advances by a second at each reading, as for a thread that is interrupted often."""

    def __init__(self) -> None:
        super().__init__()
        self._seconds = itertools.count()

    def now_ns(self) -> int:
        """Return a time that is a second later at each call."""
        return next(self._seconds) * 1_000_000_000


def test_a_thread_that_is_interrupted_while_it_writes_has_written() -> None:
    near, far = os.openpty()
    port = PySerialPort(os.ttyname(far), 115200, InterruptedClock())
    port.send(b"$VNRRG,01*72\r\n")
    assert os.read(near, 100) == b"$VNRRG,01*72\r\n"
    port.close()
    os.close(near)
    os.close(far)


def test_a_unit_that_is_unplugged_is_not_responding() -> None:
    clock = SystemClock()
    near, far = os.openpty()
    port = PySerialPort(os.ttyname(far), 115200, clock)
    os.write(near, b"last words")
    words = b""
    deadline_ns = clock.now_ns() + 2_000_000_000
    while words != b"last words" and clock.now_ns() < deadline_ns:
        clock.sleep_until_ns(clock.now_ns() + 5_000_000)
        words += b"".join(data for _, data in port.receive())
    assert words == b"last words"
    os.close(far)
    os.close(near)
    deadline_ns = clock.now_ns() + 2_000_000_000
    with pytest.raises(NotResponding, match="still there"):  # noqa: PT012 - the thread sees it in its own time
        while clock.now_ns() < deadline_ns:
            clock.sleep_until_ns(clock.now_ns() + 5_000_000)
            port.receive()
    port.close()


@pytest.mark.parametrize(
    "arguments", [["--period-s", "0"], ["--rate-deg-s", "nan"], ["--baud", "1200"], ["--foo"]]
)
def test_wrong_use_ends_with_status_2_and_no_traceback(arguments: list[str]) -> None:
    done = subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_a_link_that_another_emulator_has_taken_over_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "unit"
    first, second = (PtyLine(115200, np.random.default_rng(seed), path) for seed in (1, 2))
    first.close()
    assert os.readlink(path) == second.name
    second.close()
    assert not path.is_symlink()
