"""Tests of the section `simulation` of a configuration."""

from __future__ import annotations

import json
from pathlib import Path

from sim_hal import settings
from tests.support.section_defaults import defaults_of


def test_the_defaults_are_the_published_ones() -> None:
    """A simulation without these keys uses the defaults, so a changed default changes the interface."""
    published = json.loads(Path(__file__).with_name("published_defaults.json").read_text(encoding="utf-8"))
    assert json.loads(json.dumps(defaults_of(settings))) == published
