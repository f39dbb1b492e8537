"""Tests that any command line gives exit status 0, 1 or 2, a reason for errors, and valid JSON."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any
from unittest import mock

import pytest
from hypothesis import given, settings

from flight.app import cli
from ground.commands import COMMANDS as GROUND_COMMANDS
from knightcube.errors import UsageError
from tests.ground.report.synthetic import Recipe, make_run
from tests.support.damaged import chances, damage
from tests.support.flights import TEXT

SERVING = {"console", "files", "gateway", "link", "watch", "camera"}
"""Commands that run until they are stopped, such as servers."""
SLOW = {"index", "identify", "samples", "run"}
"""Commands that compute for seconds or simulate a run."""
NAMES = sorted({**cli.COMMANDS, **GROUND_COMMANDS}.keys() - SERVING - SLOW)
PATHS = (
    "good.yaml", "bad.yaml", "notes.txt", "run", "empty", "nowhere/run", "nowhere.png", ".", "..",
    "./run/../run", "/dev/null", "/dev/full", "/nonexistent/x", "a" * 300, "\udcff\udcfe", "é ü", "-", "new",
    "", " ",
)  # fmt: skip
NUMBERS = (
    "0", "1", "-1", "0.2", "-0.3", "1e-5", "1e9", "1e308", "1e999", "nan", "inf", "-inf", "1_0", "0x10",
    "1,2", "1.2.3", "½", "٣", "9" * 400, "-0.0", "20", "--", "1e", ".", "", " 1", "q", "40", "10",
)  # fmt: skip
WORDS = (
    "lq",
    "harris",
    "\n",
    "%s",
    "{}",
    "-h",
    "--json",
    "--help",
    "--",
    "---",
    "@file",
    "\u202e",
    "x=y",
    "--out=",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Change to a folder with a run, a configuration and unrelated files."""
    place = tmp_path_factory.mktemp("typed")
    make_run(place / "run", Recipe(duration=5.0, planned=5.0, hold=2.0, rate_hz=10.0))
    (place / "good.yaml").write_text(TEXT, encoding="utf-8")
    (place / "bad.yaml").write_text("name: [\n", encoding="utf-8")
    (place / "notes.txt").write_bytes(bytes(range(256)))
    (place / "empty").mkdir()
    with contextlib.chdir(place):
        yield place


def words_of(chance: Random, name: str) -> list[str]:
    """Return a random command line: options of the command with values that are often invalid."""
    parser = cli._parser([name])
    [commands] = [each for each in parser._actions if isinstance(each, argparse._SubParsersAction)]
    words = [name]
    for action in commands.choices[name]._actions:
        if chance.random() > (0.12 if action.option_strings else 0.85):
            continue
        count = (
            action.nargs
            if isinstance(action.nargs, int)
            else 1
            if action.nargs is None
            else chance.randint(0, 3)
        )
        words += [chance.choice(action.option_strings)] if action.option_strings else []
        pool: tuple[str, ...]
        pool = PATHS if action.type is Path else NUMBERS if action.type is not None else (*WORDS, *NUMBERS)
        if action.choices is not None:
            pool = (*map(str, action.choices), "none")
        words += [chance.choice(pool) for _ in range(count)]
    if chance.random() < 0.2:
        words.insert(chance.randint(0, len(words)), chance.choice((*PATHS, *NUMBERS, *WORDS)))
    if chance.random() < 0.1:
        damaged = damage(chance, words[-1].encode("utf-8", "replace"))
        words[-1] = damaged.replace(b"\0", b"?").decode("utf-8", "replace")
    return words


def refused(*_: Any) -> list[Path]:
    """Refuse to draw a plot, because drawing would take most of the time of the test."""
    raise UsageError("no pictures are drawn in this test")


@pytest.mark.usefixtures("folder")
@settings(max_examples=40)
@given(chance=chances())
def test_any_command_line_ends_with_a_status_and_a_reason(chance: Random) -> None:
    words = words_of(chance, chance.choice(NAMES))
    output, complaint = io.StringIO(), io.StringIO()
    with (
        mock.patch("ground.report.draw", refused),
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(complaint),
    ):
        try:
            status: Any = cli.main(words)
        except SystemExit as end:
            status = end.code or 0
    assert status in {0, 1, 2}, words
    assert "Traceback" not in complaint.getvalue()
    assert status != 2 or complaint.getvalue().strip()
    if status == 0 and "--json" in words and not any(word.startswith(("-h", "--he")) for word in words):
        json.loads(output.getvalue())
