"""`coils-off`: the coils zeroed without the flight software, where it last reached them or by the unit."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
from pathlib import Path

import pytest

from hal.drivers.pca9685 import ALL_LED_OFF_H, FULL
from hal.guardian.client import CoilReach
from tests.deploy.scripts import DEPLOY


class Tools:
    """Stand-ins for i2cset and python3, which note how they were called, and whether they succeed."""

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

    def run(self, **environment: str) -> tuple[int, list[str], str]:
        done = subprocess.run(
            [str(self.folder / "coils-off")],
            env={
                "PATH": f"{self.folder}/bin:{os.environ['PATH']}",
                "STATE_DIRECTORY": str(self.folder),
                **environment,
            },
            capture_output=True,
            text=True,
            check=False,
        )
        calls = (self.folder / "calls").read_text(encoding="utf-8").splitlines()
        return done.returncode, calls, done.stderr


@pytest.fixture
def tools(tmp_path: Path) -> Tools:
    return Tools(tmp_path)


def test_the_coils_are_zeroed_by_i2cset_first(tools: Tools) -> None:
    tools.put("i2cset", 0)
    tools.put("python3", 0)
    assert tools.run() == (0, [f"i2cset -y 1 0x40 0x{ALL_LED_OFF_H:02x} 0x{FULL:02x} b"], "")


def test_where_i2cset_fails_any_python_does_it(tools: Tools) -> None:
    tools.put("i2cset", 1)
    tools.put("python3", 0)
    status, calls, _ = tools.run()
    assert status == 0
    assert calls[1] == f"python3 -I -S {tools.folder}/smbus_byte.py /dev/i2c-1 0x40 0xfd 0x10"


def test_it_tries_again_and_says_so_when_all_is_in_vain(tools: Tools) -> None:
    tools.put("i2cset", 1)
    tools.put("python3", 1)
    status, calls, output = tools.run()
    assert status == 1
    assert len(calls) == 10, "five times each"
    assert "the coils may be driven" in output


def test_the_bus_and_address_last_flown_count_more_than_the_units(tools: Tools) -> None:
    tools.put("i2cset", 0)
    assert tools.run(KNIGHTCUBE_I2C="/dev/i2c-3", KNIGHTCUBE_PWM="0x41")[1][-1].startswith(
        "i2cset -y 3 0x41 "
    )
    CoilReach("hal.buses.smbus_byte:open_bus", "/dev/i2c-7", 0x42).note(tools.folder)
    assert tools.run(KNIGHTCUBE_I2C="/dev/i2c-3")[1][-1].startswith("i2cset -y 7 0x42 ")


def test_a_note_of_another_board_is_followed_by_the_units_word(tools: Tools) -> None:
    """The bus of the note is not there: the chip is found where the unit says, in the very first try."""
    (tools.folder / "bin/i2cset").write_text(
        f'#!/bin/sh\necho "$*" >>"{tools.folder}/calls"\n[ "$2" = 3 ]\n', encoding="utf-8"
    )
    (tools.folder / "bin/i2cset").chmod(0o755)
    tools.put("python3", 1)
    CoilReach("hal.buses.smbus_byte:open_bus", "/dev/i2c-7", 0x42).note(tools.folder)
    status, calls, _ = tools.run(KNIGHTCUBE_I2C="/dev/i2c-3", KNIGHTCUBE_PWM="0x41")
    assert status == 0
    assert [call.split()[:3] for call in calls if not call.startswith("python3")] == [
        ["-y", "7", "0x42"],
        ["-y", "3", "0x41"],
    ]


@pytest.mark.parametrize("half", ["", "/dev/i2c-7", "/dev/i2c-7 0x", "\0\0\0\0", "7 0x42\n"])
def test_half_a_note_counts_for_nothing(tools: Tools, half: str) -> None:
    tools.put("i2cset", 0)
    (tools.folder / "coils").write_text(half, encoding="ascii")
    assert tools.run(KNIGHTCUBE_I2C="/dev/i2c-3")[1] == ["i2cset -y 3 0x40 0xfd 0x10 b"]


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

    monkeypatch.setattr("hal.guardian.client.os.fsync", sync)
    monkeypatch.setattr(Path, "replace", replace)
    CoilReach("hal.buses.smbus_byte:open_bus", "/dev/knightcube-i2c", 0x42).note(tmp_path)
    assert done == ["note", "name", "folder"]
    assert (tmp_path / "coils").read_text(encoding="ascii") == "/dev/knightcube-i2c 0x42\n"


def test_a_stable_name_of_the_bus_is_followed_to_its_number(tools: Tools, tmp_path: Path) -> None:
    tools.put("i2cset", 0)
    (tmp_path / "knightcube-i2c").symlink_to("/dev/i2c-5")
    status, calls, _ = tools.run(KNIGHTCUBE_I2C=str(tmp_path / "knightcube-i2c"))
    assert status == 0
    assert calls[-1].startswith("i2cset -y 5 0x40 ")
