"""Tests that the on-board commands have the published arguments, with their defaults and choices."""

from __future__ import annotations

from pathlib import Path

import pytest

from flight.app.cli import COMMANDS
from tests.support.command_options import arguments_of, published

PUBLISHED = published(Path(__file__).with_name("published_arguments.txt"))


def test_the_commands_are_the_published_ones() -> None:
    assert list(COMMANDS) == list(PUBLISHED)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_has_its_published_arguments(name: str) -> None:
    """The published arguments do not change, because users' scripts and systemd units depend on them."""
    assert arguments_of(f"flight.app.cli.{COMMANDS[name][2]}") == PUBLISHED[name]
