"""Tests that Yamcs archives and commands a flight through the protected link."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.studies.interop.yamcs import PLANS, fly
from tests.support.yamcs_server import missing


@pytest.mark.slow
@pytest.mark.skipif(bool(missing()), reason=missing() or "-")
def test_yamcs_archives_and_commands_a_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The archive has every packet and value, every command completes, and no socket leaves loopback."""
    sound = fly(tmp_path, PLANS["short"])
    said = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert sound, said
    assert len(said) == 5
