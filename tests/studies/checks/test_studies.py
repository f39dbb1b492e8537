"""Tests that `python -m tests.studies NAME` runs a study, and that it lists the studies without a name."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from tests.studies.campaigns.__main__ import campaigns

ROOT = Path(__file__).resolve().parents[3]


def _run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tests.studies", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", ["campaigns", "bench", "same_bytes", "house", "mutants"])
def test_a_study_gets_the_rest_of_the_line(name: str) -> None:
    done = _run(name, "--help")
    assert done.returncode == 0
    assert "usage:" in done.stdout


def test_every_campaign_is_listed_and_loads_under_its_name() -> None:
    listed = campaigns()
    assert len(listed) > 40
    for module, constant in (("faults", "FAULTS"), ("knowledge", "AGED_ELEMENTS"), ("knowledge", "CALENDAR")):
        loaded = getattr(importlib.import_module(f"tests.studies.campaigns.{module}"), constant)
        assert listed[loaded.name].load() is loaded
        assert listed[loaded.name].purpose == loaded.purpose


def test_help_lists_the_studies() -> None:
    done = _run("--help")
    assert done.returncode == 0
    assert "usage: python -m tests.studies NAME" in done.stdout
    assert "campaigns" in done.stdout


def test_an_unknown_study_is_wrong_use_and_the_known_ones_are_listed() -> None:
    done = _run("nosuch")
    assert done.returncode == 2
    assert "there is no study 'nosuch'" in done.stderr
    assert "campaigns" in done.stderr
    assert "checks" not in done.stderr
