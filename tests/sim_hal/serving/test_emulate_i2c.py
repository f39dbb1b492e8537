"""Tests that unchanged programs, in their own processes, open the emulated bus as /dev/i2c-N."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from sim_hal.__main__ import main

COMMAND = [sys.executable, "-m", "sim_hal", "emulate", "i2c"]
PWM, MONITOR, ALL_CALL = 0x40, 0x45, 0x70

pytestmark = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="no C compiler builds the preload library"
)
debian_tools = pytest.mark.skipif(
    shutil.which("i2cdetect", path="/usr/sbin:/sbin:" + os.environ["PATH"]) is None,
    reason="Debian's i2c-tools are not installed",
)


@pytest.fixture(scope="module")
def environment() -> Iterator[Mapping[str, str]]:
    """Serve the bus as /dev/i2c-7; yield the environment variables that programs need."""
    with subprocess.Popen([*COMMAND, "--bus", "7", "--json"], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        facts: dict[str, Any] = json.loads(process.stdout.readline())
        assert facts["device"] == "/dev/i2c-7"
        assert facts["parts"] == {"pca9685": PWM, "ina219": MONITOR}
        try:
            yield {**os.environ, **facts["environment"], "PATH": "/usr/sbin:/sbin:" + os.environ["PATH"]}
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(timeout=5) == 0


def run(environment: Mapping[str, str], script: str) -> str:
    """Return the output of a Python script that contains no code for the emulation."""
    command = [sys.executable, "-c", textwrap.dedent(script)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_smbus2_makes_every_transfer(environment: Mapping[str, str]) -> None:
    """smbus2 makes every type of transfer, with the values of the data sheets.

    At power-on, PRE_SCALE is 0x1E and Config is 0x399F, sent with the high byte first.
    """
    said = run(
        environment,
        """
        from smbus2 import SMBus, i2c_msg
        with SMBus(7) as bus:
            bus.write_quick(0x40)
            print(hex(bus.read_byte_data(0x40, 0xFE)), hex(bus.read_word_data(0x45, 0)))
            bus.write_byte(0x40, 0xFE)
            print(hex(bus.read_byte(0x40)))
            bus.write_byte_data(0x40, 0, 0x20)
            bus.write_i2c_block_data(0x40, 6, list(range(1, 9)))
            print(bus.read_i2c_block_data(0x40, 6, 8))
            bus.write_word_data(0x45, 5, 0x0050)
            print(hex(bus.process_call(0x45, 5, 0x0020)), hex(bus.read_word_data(0x45, 5)))
            register, answer = i2c_msg.write(0x40, [6]), i2c_msg.read(0x40, 40)
            bus.i2c_rdwr(register, answer)
            print(list(answer)[:8], len(answer))
            for attempt in (bus.read_byte, bus.write_quick):
                try:
                    attempt(0x22)
                except OSError as error:
                    print(error.errno)
            try:
                bus.read_block_data(0x40, 6)
            except OSError as error:
                print(error.errno)
        """,
    )
    assert said.splitlines() == [
        "0x1e 0x9f39",
        "0x1e",
        "[1, 2, 3, 4, 5, 6, 7, 8]",
        "0x20 0x20",
        "[1, 2, 3, 4, 5, 6, 7, 8] 40",
        "121",
        "121",
        "95",
    ]


def test_files_copied_descriptors_and_child_processes_work_as_usual(
    environment: Mapping[str, str], tmp_path: Path
) -> None:
    (tmp_path / "note").write_text("kept", encoding="utf-8")
    said = run(
        environment,
        f"""
        import fcntl, os, stat, subprocess
        print(open({str(tmp_path / "note")!r}).read(), os.path.exists("/dev/i2c-8"))
        print(stat.S_ISCHR(os.stat("/dev/i2c-7").st_mode), os.access("/dev/i2c-7", os.R_OK | os.W_OK))
        bus = os.open("/dev/i2c-7", os.O_RDWR)
        fcntl.ioctl(bus, 0x0703, 0x40)
        os.write(bus, bytes([0x00, 0x11]))  # as at power-on: the register pointer stays
        os.write(bus, bytes([0xFE]))
        other = os.dup(bus)
        os.close(bus)
        print(os.read(other, 1))
        again = os.open({str(tmp_path / "note")!r}, os.O_RDONLY)  # takes the number that became free
        print(again == bus, os.read(again, 4))
        if os.fork() == 0:
            print(os.read(other, 1), flush=True)
            os._exit(0)
        os.wait()
        for request, argument in ((0x0704, 1), (0x0708, 1), (0x0703, 0x80), (0x1234, 0)):
            try:
                fcntl.ioctl(other, request, argument)
            except OSError as error:
                print(error.errno, end=" ")
        """,
    )
    assert said.splitlines() == [
        "kept False",
        "True True",
        "b'\\x1e'",
        "True b'kept'",
        "b'\\x1e'",
        "22 22 22 25 ",
    ]


@pytest.mark.skipif(
    importlib.util.find_spec("Adafruit_PureIO") is None,
    reason="adafruit-pureio, another's client, is not installed",
)
def test_adafruits_client_drives_a_coil_and_reads_its_current(environment: Mapping[str, str]) -> None:
    """Adafruit's client drives a coil and reads its current.

    A fully driven coil x draws 3.4 V / 23 ohm = 148 mA, which is 1478 steps of 10 uV across 0.1 ohm.
    """
    said = run(
        environment,
        """
        import time
        from Adafruit_PureIO.smbus import SMBus
        bus = SMBus(7)
        bus.write_byte_data(0x40, 0, 0x20)
        bus.write_i2c_block_data(0x40, 6, [0, 16, 0, 0, 0, 0, 0, 16])
        time.sleep(0.05)
        print(int.from_bytes(bus.read_i2c_block_data(0x45, 1, 2), "big"))
        print(hex(bus.read_word_data(0x40, 6)), hex(bus.read_byte_data(0x40, 0)))
        """,
    )
    shunt, register = said.splitlines()
    assert int(shunt) == pytest.approx(1478, abs=40)  # the tolerance includes 3.5 mA of noise
    assert register == "0x1000 0x20"


@debian_tools
def test_debians_tools_find_and_read_the_parts(environment: Mapping[str, str]) -> None:
    def tool(*words: str) -> str:
        done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=10, check=True)
        return done.stdout

    tool("i2cset", "-y", "7", "0x40", "0", "0x21")  # MODE1 as at power-on, but without SLEEP
    table = tool("i2cdetect", "-y", "7").split("\n", 1)[1]
    found = {int(word, 16) for line in table.splitlines() for word in line[3:].split() if word != "--"}
    assert found == {PWM, MONITOR, ALL_CALL}
    assert tool("i2cget", "-y", "7", "0x40", "0xfe").strip() == "0x1e"
    assert tool("i2cget", "-y", "7", "0x45", "0", "w").strip() == "0x9f39"


def test_the_flights_own_driver_reads_it(environment: Mapping[str, str]) -> None:
    said = run(
        environment,
        """
        from hal.buses.linux_wires import LinuxI2cBus
        bus = LinuxI2cBus(7)
        print(bus.read_i2c_block_data(0x45, 0, 2))
        """,
    )
    assert said == "[57, 159]\n"


def test_a_bus_with_a_name_of_its_own_is_opened_by_this_name_only(environment: Mapping[str, str]) -> None:
    """A bus with a persistent name is opened only by this name.

    The unit's variable KNIGHTCUBE_I2C, which is meant for `coils-off`, does not disturb the emulation.
    """
    named = {**environment, "KNIGHTCUBE_I2C_BUS": "/dev/knightcube-i2c", "KNIGHTCUBE_I2C": "/dev/i2c-1"}
    script = """
    import os
    from hal.buses.linux_wires import LinuxI2cBus
    print(LinuxI2cBus("/dev/knightcube-i2c").read_i2c_block_data(0x45, 0, 2), os.path.exists("/dev/i2c-7"))
    """
    assert run(named, script) == "[57, 159] False\n"


def test_a_program_runs_beside_the_server_and_gives_its_status() -> None:
    script = "import os; os.open('/dev/i2c-1', os.O_RDWR); os._exit(7)"
    done = subprocess.run([*COMMAND, "--", sys.executable, "-c", script], timeout=20, check=False)
    assert done.returncode == 7


def test_a_bus_whose_server_is_gone_does_not_answer(environment: Mapping[str, str]) -> None:
    gone = {**environment, "KNIGHTCUBE_I2C_SOCKET": "/nonexistent/bus.sock"}
    script = """
    import os
    try:
        os.open("/dev/i2c-7", os.O_RDWR)
    except OSError as error:
        print(error.strerror)
    """
    assert run(gone, script) == "No such device\n"


@pytest.mark.parametrize(
    ("arguments", "variables", "message"),
    [
        ([], {"CC": "no-such-compiler"}, "no C compiler (no-such-compiler)"),
        ([], {"CC": "false"}, "does not compile: status 1"),
        (["--", "no-such-program"], {}, "no-such-program cannot be run"),
        (["--config", "no-such.yaml"], {}, "no-such.yaml"),
        (["--bus", "-1"], {}, "--bus"),
    ],
)
def test_wrong_use_is_explained_in_one_line(
    arguments: list[str],
    variables: dict[str, str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    try:
        status = main(["emulate", "i2c", *arguments])
    except SystemExit as ended:
        status = int(ended.code or 0)
    said = capsys.readouterr()
    assert (status, said.out) == (2, "")
    assert message in said.err.splitlines()[-1]
