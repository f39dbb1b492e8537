"""Wrong command lines, in process: whatever is typed, the answer is a status and a line, never a traceback.

A flight that would really begin is not flown. Broken promises are: a status other than 0, 1, 2; wrong use
without a word on standard error; with --json and status 0 anything but one JSON object on standard output.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import shutil
import tempfile
import weakref
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from flight import cli
from flight.errors import UsageError
from tests.fuzz.harness import Finding
from tests.fuzz.mutation import Draw, chance, damage, integer
from tests.report.synthetic import Recipe, make_run

ROOT = Path(__file__).resolve().parents[2]

_PATHS = (
    "good.yaml", "bad.yaml", "notes.txt", "run", "runs", "empty", "nowhere/run", "nowhere.png", "flat.png",
    "short.png", ".", "..", "./run/../run", "/dev/null", "/dev/full", "/nonexistent/x", "a" * 300,
    "\udcff\udcfe", "é ü", "-", "new", "run/flight-0001.ccsds", "", " ",
)  # fmt: skip
_NUMBERS = (
    "0", "1", "-1", "0.2", "-0.3", "1e-5", "1e9", "1e308", "-1e308", "1e999", "nan", "-nan", "inf", "-inf",
    "1_0", "0x10", "1,2", "1.2.3", "½", "٣", "9" * 400, "-0.0", "20", "0.6999", "--", "1e", ".", "", " 1",
    "q", "40", "10",
)  # fmt: skip
_WORDS = (
    "lq", "harris", "likelihood", "binary", "q-method", "quest", "\n", "%s", "{}", "-h", "--json", "--help",
    "--version", "--", "-", "---", "--no-figures", "@file", "run", "report", "\u202e", "x=y", "--seed=-1",
    "--out", "--out=",
)  # fmt: skip


class Arguments:
    """The target."""

    def __init__(self) -> None:
        held = Path(tempfile.mkdtemp())
        weakref.finalize(self, shutil.rmtree, held, ignore_errors=True)
        self._folder, self._made = held / "inside" / "work", held / "made"
        self._made.mkdir()
        _furnish(self._made)
        self._options = {name: _actions(name) for name in cli.COMMANDS}
        self._words: list[str] = []
        self._since_clean = 1000

    def last(self) -> str:
        """Return the last command line."""
        return repr(self._words)

    def attempt(self, draw: Draw) -> Counter[str]:
        """Type one command line."""
        self._words = words = self._command_line(draw)
        self._since_clean += 1
        if self._since_clean >= 200:
            self._since_clean = 0
            shutil.rmtree(self._folder, ignore_errors=True)
            shutil.copytree(self._made, self._folder)
        status, output, complaint = _typed(words, self._folder)
        if status not in {0, 1, 2}:
            raise Finding(f"status {status}")
        if "Traceback" in complaint or (status == 2 and not complaint.strip()):
            raise Finding(f"status {status} with: {complaint[-300:]!r}")
        if status == 0 and "--json" in words and not {"-h", "--help", "--version"} & set(words):
            try:
                json.loads(output)
            except ValueError as error:
                raise Finding(f"--json gave {output[:100]!r}") from error
        return Counter(
            {f"status {status}": 1, words[0] if words and words[0] in cli.COMMANDS else "no command": 1}
        )

    def _command_line(self, draw: Draw) -> list[str]:
        names = list(cli.COMMANDS)
        name = names[integer(draw, 0, len(names) - 1)]
        words: list[str] = []
        for action in self._options[name]:
            wanted = 0.85 if not action.option_strings else 0.12
            if chance(draw, wanted):
                words += _words_of(draw, action)
        for _ in range(integer(draw, 0, 2) if chance(draw, 0.4) else 0):
            words.insert(integer(draw, 0, len(words)), _anything(draw))
        if words and chance(draw, 0.1):
            del words[integer(draw, 0, len(words) - 1)]
        if words and chance(draw, 0.1):
            at = integer(draw, 0, len(words) - 1)
            spoilt = damage(draw, os.fsencode(words[at])).replace(b"\0", b"?")
            words[at] = os.fsdecode(spoilt)
        return [name, *words] if chance(draw, 0.97) else words


def _typed(words: list[str], folder: Path) -> tuple[Any, str, str]:
    """Return status, standard output and standard error of a command line typed in a folder."""
    raw = io.BytesIO()
    output = io.TextIOWrapper(raw, encoding="utf-8", errors="strict", write_through=True)
    complaint = io.StringIO()
    with _in_folder(folder), contextlib.redirect_stdout(output), contextlib.redirect_stderr(complaint):
        try:
            status: Any = cli.main(words)
        except SystemExit as end:
            status = 0 if end.code is None else end.code
    return status, raw.getvalue().decode(), complaint.getvalue()


@contextlib.contextmanager
def _in_folder(folder: Path) -> Iterator[None]:
    """Work in a folder, with nothing flown."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        with mock.patch("flight.app.fly", _not_flown):
            yield
    finally:
        os.chdir(before)


def _not_flown(order: Any, _: Any = None) -> Any:
    """Stand in for `flight.app.fly`: look at the order as it would, and refuse at the last moment."""
    from flight import app  # noqa: PLC0415 - the whole flight hangs on it

    app._load(order)
    raise UsageError("this is a rehearsal: nothing is flown")


def _actions(name: str) -> list[argparse.Action]:
    """Return what a command takes."""
    parser = cli._parser([name])
    commands = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return list(commands.choices[name]._actions)


def _words_of(draw: Draw, action: argparse.Action) -> list[str]:
    """Return an option with as many values as it takes, mostly; or a positional argument."""
    count = (
        1 if action.nargs is None else action.nargs if isinstance(action.nargs, int) else integer(draw, 0, 3)
    )
    if chance(draw, 0.05):
        count = integer(draw, 0, 4)
    flags = (
        [action.option_strings[integer(draw, 0, len(action.option_strings) - 1)]]
        if action.option_strings
        else []
    )
    return flags + [_value(draw, action) for _ in range(count)]


def _value(draw: Draw, action: argparse.Action) -> str:
    if chance(draw, 0.1):
        return _anything(draw)
    if action.choices is not None and chance(draw, 0.8):
        choices = [str(choice) for choice in action.choices]
        return choices[integer(draw, 0, len(choices) - 1)]
    pool = _PATHS if action.type is Path else _NUMBERS if action.type is not None else (*_WORDS, *_NUMBERS)
    # The first of the paths are what a command wants: they go the farthest.
    return pool[integer(draw, 0, len(pool) - 1 if chance(draw, 0.6) else min(8, len(pool) - 1))]


def _anything(draw: Draw) -> str:
    pool = (*_PATHS, *_NUMBERS, *_WORDS)
    return pool[integer(draw, 0, len(pool) - 1)]


def _furnish(folder: Path) -> None:
    """Put into a folder what commands may be pointed at: small, sound and unsound."""
    from PIL import Image  # noqa: PLC0415 - an extra

    (folder / "good.yaml").write_text((ROOT / "config" / "step_demo.yaml").read_text(encoding="utf-8"))
    (folder / "bad.yaml").write_text("name: [\n")
    (folder / "notes.txt").write_bytes(bytes(range(256)))
    (folder / "empty").mkdir()
    make_run(folder / "run", Recipe(duration=5.0, planned=5.0, hold=2.0, rate_hz=10.0))
    shutil.copytree(folder / "run", folder / "runs" / "run-000001")
    Image.new("L", (64, 48), 10).save(folder / "flat.png")
    (folder / "short.png").write_bytes((folder / "flat.png").read_bytes()[:60])
