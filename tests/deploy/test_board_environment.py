"""Tests of the environment that the installer makes for a board, with real wheels and no network."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tests.deploy.scripts import ROOT, TESTBED

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("systemctl") is None, reason="systemctl is missing: install systemd"),
]

_SOURCES = ("knightcube", "flight", "hal", "sim_hal", "ground", "deploy", "config")
_FILES = ("pyproject.toml", "README.md", "LICENSE")


class Board:
    """A virtual environment in an image, made by `install.sh` from a copy of the sources."""

    def __init__(self, folder: Path) -> None:
        self.source = folder / "source"
        for name in _SOURCES:
            shutil.copytree(ROOT / name, self.source / name, ignore=shutil.ignore_patterns("__pycache__"))
        for name in _FILES:
            shutil.copy(ROOT / name, self.source)
        self.folder = folder
        self.venv = folder / "image/opt/knightcube/venv"

    def install(self) -> None:
        """Install with the dependencies of the interpreter that runs the tests."""
        python = self.folder / "python"
        # A line in a .pth file adds a folder to the search path. Python ignores .pth files in the added
        # folder, so the packages of this checkout are not found.
        python.write_text(
            f"""#!/bin/sh
if [ "$2" = venv ]; then
    {sys.executable} -m venv --without-pip "$3"
    echo {sysconfig.get_path("purelib")} >"$(echo "$3"/lib/python3*/site-packages)/dependencies.pth"
else
    exec {sys.executable} "$@"
fi
""",
            encoding="utf-8",
        )
        python.chmod(0o755)
        words = ["sh", str(self.source / "deploy/install.sh"), "--config", str(TESTBED)]
        done = subprocess.run(
            [*words, "--python", str(python)],
            env={**os.environ, "PIP_NO_INDEX": "1", "DESTDIR": str(self.folder / "image")},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr

    def python(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run the board's Python in a folder that is not a checkout."""
        return subprocess.run(
            [str(self.venv / "bin/python"), *words],
            cwd=self.folder,
            env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
            capture_output=True,
            text=True,
            check=False,
        )


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Board:
    made = Board(tmp_path_factory.mktemp("board"))
    made.install()
    return made


def test_a_board_has_the_flight_software_and_no_ground_tools(board: Board) -> None:
    names = {name: board.python("-c", f"import {name}").returncode for name in ("flight", "hal", "ground")}
    assert names == {"flight": 0, "hal": 0, "ground": 1}
    packages = next(board.venv.glob("lib/python3*/site-packages"))
    assert not (packages / "ground").exists()


def test_a_board_flies_without_the_ground_tools(board: Board) -> None:
    config = str(board.source / "config/step_demo.yaml")
    done = board.python("-m", "flight", "run", config, "--duration", "1", "--out", "flown")
    assert done.returncode == 0, done.stderr
    assert (board.folder / "flown").is_dir()


def test_the_help_of_a_board_lists_only_installed_commands(board: Board) -> None:
    done = board.python("-m", "flight", "--help")
    assert (done.returncode, done.stderr) == (0, "")
    commands = done.stdout.partition("COMMAND")[2].partition("examples:")[0]
    assert "run" in commands
    assert "report" not in commands
    wrong = board.python("-m", "flight", "report", "flown")
    assert wrong.returncode == 2
    assert "Traceback" not in wrong.stderr
