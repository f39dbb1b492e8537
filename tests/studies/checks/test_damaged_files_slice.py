"""Runs a slice of the campaign `damaged-files`, and tests that the campaign would report a failed start."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.studies.campaigns import damaged_files
from tests.studies.campaigns.damaged_files import DamagedBoard

pytestmark = pytest.mark.skipif(
    shutil.which("systemctl") is None, reason="systemctl is missing: install systemd"
)


def test_a_release_flies_after_each_of_some_flipped_bits(tmp_path: Path) -> None:
    board = DamagedBoard(tmp_path)
    names = {path.relative_to(board.board.root).as_posix() for path in board.files()}
    for name in (
        "opt/knightcube/bin/fly",
        "opt/knightcube/spare/sums",
        "link/keys/spi-1.a",
        "link/witness/spi-4.b",
    ):
        assert name in names
    assert {"state/releases.json", "state/coils", "link/files/transfers/numbers.json"} <= names
    flips = [
        board.flip(path, 8 * (path.stat().st_size // 2) + number % 8)
        for number, path in enumerate(board.files()[::3])
    ]
    assert damaged_files.summarise([{"flips": flips}], tmp_path).facts["bad"] == []


def test_a_launcher_without_a_second_copy_is_found_out(tmp_path: Path) -> None:
    board = DamagedBoard(tmp_path)
    shutil.rmtree(board.board.prefix / "spare")
    fly = board.board.prefix / "bin/fly"
    flip = board.flip(fly, 8 * fly.read_bytes().index(b"exec ") + 1)
    assert flip["problems"] or not flip["reported"]
