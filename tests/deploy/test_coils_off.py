"""Tests that `coils-off` zeroes the coils without the flight software, by hand and as a systemd unit."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hal.buses import smbus_byte
from hal.drivers.pca9685 import ALL_LED_OFF_H, AUTO_INCREMENT, CHANNELS, FULL, LED0_ON_L, MODE1
from hal.interfaces.guardian import CoilReach
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from sim_hal.emulators.pca9685 import EmulatedPca9685
from sim_hal.serving.emulate_i2c import I2cServer, library
from tests.deploy.scripts import DEPLOY


class Tools:
    """Test doubles of i2cset and python3.

    Each test double records its calls, and succeeds or fails as set.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "bin").mkdir()
        shutil.copy(DEPLOY / "coils-off", folder)

    def put(self, name: str, status: int) -> None:
        tool = self.folder / "bin" / name
        tool.write_text(
            f'#!/bin/sh\necho "{name} $*" >>"{self.folder}/calls"\nexit {status}\n', encoding="utf-8"
        )
        tool.chmod(0o755)

    def emulate(self, bus: Path) -> None:
        """Make python3 open the bus served at a socket as /dev/i2c-7, without i2cset."""
        shutil.copy(Path(smbus_byte.__file__), self.folder)
        self.put("i2cset", 1)
        (self.folder / "bin/python3").write_text(
            f"#!/bin/sh\nexport LD_PRELOAD={library()} KNIGHTCUBE_I2C_SOCKET={bus} KNIGHTCUBE_I2C_BUS=7\n"
            f'exec {sys.executable} "$@"\n',
            encoding="utf-8",
        )
        (self.folder / "bin/python3").chmod(0o755)

    def start(self, **environment: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [str(self.folder / "coils-off")],
            env={
                "PATH": f"{self.folder}/bin:{os.environ['PATH']}",
                "STATE_DIRECTORY": str(self.folder),
                **environment,
            },
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, **environment: str) -> tuple[int, list[str], str]:
        with self.start(**environment) as process:
            said = process.communicate(timeout=60)[1]
        calls = (self.folder / "calls").read_text(encoding="utf-8").splitlines()
        return process.returncode, calls, said


@pytest.fixture
def tools(tmp_path: Path) -> Tools:
    return Tools(tmp_path)


def test_the_program_of_the_sources_needs_no_installation(tmp_path: Path) -> None:
    """In a clone of the repository, `deploy/coils-off` finds `smbus_byte.py` among the sources."""
    (tmp_path / "i2cset").write_text("#!/bin/sh\nexit 1\n")
    (tmp_path / "i2cset").chmod(0o755)
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "KNIGHTCUBE_I2C": str(tmp_path / "none")}
    environment["STATE_DIRECTORY"] = str(tmp_path)
    done = subprocess.run(
        [DEPLOY / "coils-off"], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert f"smbus_byte: {tmp_path}/none, address 0x40: No such file or directory" in done.stderr


def test_the_coils_are_zeroed_by_i2cset_first(tools: Tools) -> None:
    tools.put("i2cset", 0)
    tools.put("python3", 0)
    assert tools.run() == (0, [f"i2cset -y 1 0x40 0x{ALL_LED_OFF_H:02x} 0x{FULL:02x} b"], "")


def test_python_zeroes_the_coils_if_i2cset_fails(tools: Tools) -> None:
    tools.put("i2cset", 1)
    tools.put("python3", 0)
    status, calls, _ = tools.run()
    assert status == 0
    assert calls[1] == f"python3 -I -S {tools.folder}/smbus_byte.py /dev/i2c-1 0x40 0xfd 0x10"


def test_each_tool_is_tried_five_times_before_the_failure_is_reported(tools: Tools) -> None:
    tools.put("i2cset", 1)
    tools.put("python3", 1)
    status, calls, output = tools.run()
    assert status == 1
    assert len(calls) == 10, "five times each"
    assert "the coils may be driven" in output


def test_the_address_of_the_unit_and_the_last_flown_address_are_written(tools: Tools) -> None:
    tools.put("i2cset", 0)
    CoilReach("hal.buses.smbus_byte:open_bus", "/dev/i2c-7", ((0x42, 0xFD, 0x10),)).note(tools.folder)
    status, calls, said = tools.run(KNIGHTCUBE_I2C="/dev/i2c-3", KNIGHTCUBE_PWM="0x41")
    assert (status, said) == (0, "")
    assert sorted(calls) == ["i2cset -y 3 0x41 0xfd 0x10 b", "i2cset -y 7 0x42 0xfd 0x10 b"]


def test_an_address_that_the_unit_and_the_note_share_is_written_once(tools: Tools) -> None:
    tools.put("i2cset", 0)
    CoilReach("hal.buses.smbus_byte:open_bus", "/dev/i2c-3", ((0x41, 0xFD, 0x10),)).note(tools.folder)
    assert tools.run(KNIGHTCUBE_I2C="/dev/i2c-3", KNIGHTCUBE_PWM="0x41")[1] == [
        "i2cset -y 3 0x41 0xfd 0x10 b"
    ]


def test_every_write_of_a_unit_and_of_a_note_is_executed_whatever_another_chip_does(tools: Tools) -> None:
    """H-bridges with an I2C interface have one chip per coil, and one register is cleared in each chip."""
    (tools.folder / "bin/i2cset").write_text(
        f'#!/bin/sh\necho "$*" >>"{tools.folder}/calls"\n[ "$3" != 0x61 ]\n', encoding="utf-8"
    )
    (tools.folder / "bin/i2cset").chmod(0o755)
    tools.put("python3", 1)
    writes = tuple((address, 0x00, 0x00) for address in (0x60, 0x61, 0x62))
    CoilReach("hal.buses.smbus_byte:open_bus", "/dev/i2c-7", writes).note(tools.folder)
    status, calls, said = tools.run(
        KNIGHTCUBE_I2C="/dev/i2c-3", KNIGHTCUBE_PWM="0x44 0x02 0x00 0x45 0x02 0x00"
    )
    assert status == 0, "the unit's chips acknowledged"
    written = {call for call in calls if call.startswith("-y")}
    assert written == {
        *(f"-y 7 0x6{n} 0x00 0x00 b" for n in range(3)),
        *(f"-y 3 0x4{n} 0x02 0x00 b" for n in (4, 5)),
    }
    assert "0x61 on /dev/i2c-7 does not answer" in said
    assert "0x62" not in said


def test_a_hanging_address_does_not_delay_the_other_address(tools: Tools) -> None:
    (tools.folder / "bin/i2cset").write_text(
        f'#!/bin/sh\necho "$3" >>"{tools.folder}/calls"\n'
        f'[ "$3" = 0x42 ] || exit 0\nuntil [ -e "{tools.folder}/end" ]; do sleep 0.02; done\n',
        encoding="utf-8",
    )
    (tools.folder / "bin/i2cset").chmod(0o755)
    for hanging, other in (("note", "unit"), ("unit", "note")):
        addresses = {hanging: 0x42, other: 0x41}
        CoilReach("hal.buses.smbus_byte:open_bus", "/dev/i2c-7", ((addresses["note"], 0xFD, 0x10),)).note(
            tools.folder
        )
        with tools.start(KNIGHTCUBE_PWM=f"0x{addresses['unit']:02x}") as process:
            calls = tools.folder / "calls"
            while not calls.exists() or sorted(calls.read_text(encoding="ascii").split()) != ["0x41", "0x42"]:
                assert process.poll() is None
                time.sleep(0.01)
            (tools.folder / "end").touch()
            assert process.wait(60) == 0
        for name in ("end", "calls"):
            (tools.folder / name).unlink()


class Chips:
    """Two PWM chips that drive all their channels, on an emulated bus that programs open as /dev/i2c-7."""

    ADDRESSES = (0x40, 0x41)

    def __init__(self, folder: Path) -> None:
        self._chips = [EmulatedPca9685(address, time.monotonic_ns) for address in self.ADDRESSES]
        for chip in self._chips:
            chip.write(chip.address, bytes([MODE1, AUTO_INCREMENT]))
            chip.write(chip.address, bytes([LED0_ON_L, *[0, FULL, 0, 0] * CHANNELS]))
        self.bus = EmulatedI2cBus(self._chips)
        self.server = I2cServer(self.bus, folder / "bus.sock")

    def driving(self) -> list[int]:
        """Return the addresses of the chips with at least one active output."""
        return [chip.address for chip in self._chips if any(map(chip.duty, range(CHANNELS)))]


@pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="no C compiler builds the preload library"
)
@pytest.mark.parametrize(
    ("note", "unit", "refusals", "left", "status"),
    [
        (0x40, 0x41, 0, [], 0),
        (0x41, 0x40, 0, [], 0),
        (0x40, 0x42, 0, [0x41], 0),
        (0x42, 0x41, 0, [0x40], 0),
        (0x40, 0x41, 3, [], 0),
        (0x41, 0x40, 3, [], 0),
        (0x42, 0x43, 0, [0x40, 0x41], 1),
    ],
)
def test_each_chip_that_acknowledges_is_switched_off_even_if_another_does_not(
    tools: Tools, note: int, unit: int, refusals: int, left: list[int], status: int
) -> None:
    """A PWM chip can fail to acknowledge its first bytes. An address without a chip never acknowledges."""
    chips = Chips(tools.folder)
    assert chips.driving() == list(chips.ADDRESSES)
    if refusals:
        chips.bus.nack(0x41, refusals)
    tools.emulate(tools.folder / "bus.sock")
    CoilReach("hal.buses.smbus_byte:open_bus", "/dev/i2c-7", ((note, 0xFD, 0x10),)).note(tools.folder)
    process = tools.start(KNIGHTCUBE_I2C="/dev/i2c-7", KNIGHTCUBE_PWM=f"0x{unit:02x}")
    while process.poll() is None:
        chips.server.serve(0.02)
    chips.server.close()
    said = process.communicate()[1]
    assert chips.driving() == left
    assert process.returncode == status
    for address in (note, unit):
        absent = address not in chips.ADDRESSES
        assert (f"the PWM chip at 0x{address:02x} on /dev/i2c-7 does not answer" in said) == absent


@pytest.mark.parametrize("kind", ["FIFO", "sparse"])
def test_an_endless_note_does_not_prevent_the_write_to_the_address_of_the_unit(
    tools: Tools, kind: str
) -> None:
    tools.put("i2cset", 0)
    if kind == "FIFO":
        os.mkfifo(tools.folder / "coils")
    else:
        (tools.folder / "coils").touch()
        os.truncate(tools.folder / "coils", 1 << 40)
    assert tools.run(KNIGHTCUBE_I2C="/dev/i2c-3")[1] == ["i2cset -y 3 0x40 0xfd 0x10 b"]


@pytest.mark.parametrize("half", ["", "/dev/i2c-7", "/dev/i2c-7 0x", "\0\0\0\0", "7 0x42\n"])
def test_an_incomplete_note_is_ignored(tools: Tools, half: str) -> None:
    tools.put("i2cset", 0)
    (tools.folder / "coils").write_text(half, encoding="ascii")
    assert tools.run(KNIGHTCUBE_I2C="/dev/i2c-3")[1] == ["i2cset -y 3 0x40 0xfd 0x10 b"]


def test_a_note_with_a_flipped_bit_writes_to_no_other_chip(tools: Tools) -> None:
    tools.put("i2cset", 0)
    CoilReach("hal.buses.smbus_byte:open_bus", "/dev/i2c-7", ((0x42, 0xFD, 0x10),)).note(tools.folder)
    whole = (tools.folder / "coils").read_bytes()
    for place in (3, 9, 14, 16, 40, 79):
        (tools.folder / "coils").write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        status, _, said = tools.run(KNIGHTCUBE_I2C="/dev/i2c-3")
        assert (status, "coils is damaged and not used" in said) == (0, True)
    assert set((tools.folder / "calls").read_text(encoding="utf-8").splitlines()) == {
        "i2cset -y 3 0x40 0xfd 0x10 b"
    }


def test_the_note_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    real_sync, real_replace = os.fsync, Path.replace

    def sync(file: int) -> None:
        done.append("folder" if stat.S_ISDIR(os.fstat(file).st_mode) else "note")
        real_sync(file)

    def replace(path: Path, target: Path) -> Path:
        done.append("name")
        return real_replace(path, target)

    monkeypatch.setattr("hal.interfaces.guardian.os.fsync", sync)
    monkeypatch.setattr(Path, "replace", replace)
    CoilReach("hal.buses.smbus_byte:open_bus", "/dev/knightcube-i2c", ((0x42, 0xFD, 0x10),)).note(tmp_path)
    assert done == ["note", "name", "folder"]
    text = "/dev/knightcube-i2c 0x42 0xfd 0x10"
    digest = hashlib.sha256(text.encode()).hexdigest()
    assert (tmp_path / "coils").read_text(encoding="ascii") == f"{text} {digest}\n"


def test_a_stable_name_of_the_bus_is_followed_to_its_number(tools: Tools, tmp_path: Path) -> None:
    tools.put("i2cset", 0)
    (tmp_path / "knightcube-i2c").symlink_to("/dev/i2c-5")
    status, calls, _ = tools.run(KNIGHTCUBE_I2C=str(tmp_path / "knightcube-i2c"))
    assert status == 0
    assert calls[-1].startswith("i2cset -y 5 0x40 ")
