"""Yamcs, a ground station of other authors, follows and commands a flight through the protected link.

`python -m tests.studies.interop.yamcs FOLDER` flies the commands that need minutes.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ground.yamcs import files, main
from tests.studies.interop.yamcs import PLANS, fly
from tests.studies.interop.yamcs_server import missing


def test_the_command_writes_the_whole_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["yamcs", str(tmp_path), "--epoch", "2026-11-23T12:00:00"])
    main()
    written = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert written == set(files(tmp_path, "127.0.0.1:1", 1, "2026-11-23T12:00:00"))


@pytest.mark.slow
@pytest.mark.skipif(bool(missing()), reason=missing() or "-")
def test_yamcs_archives_and_commands_a_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every packet and value is ours, every command completed, no warning, no socket beyond loopback."""
    sound = fly(tmp_path, PLANS["short"])
    said = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert sound, said
    assert len(said) == 5
