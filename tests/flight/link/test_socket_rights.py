"""Tests that opening a command socket does not change the permissions of files that the process creates."""

from __future__ import annotations

import os
from pathlib import Path

from flight.link.commands import open_unix


def test_the_umask_of_the_process_is_as_before(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        open_unix(tmp_path / "socket").close()
        assert os.umask(0o027) == 0o027
    finally:
        os.umask(before)
