"""Wrong command lines, in process: whatever is typed, the answer is a status and a line, never a traceback.

A part of them are right ones with a word or two changed, or with a damaged file behind a name: they lead
far into the commands. A flight lasts three control cycles, a camera takes two frames, samples are small,
nobody waits for a log to grow, few pictures are really drawn. A part is typed in a process that a signal or
a closed pipe disturbs (`interrupted`). Broken promises are: a status other than 0, 1, 2; wrong use without
a word on standard error; with --json and status 0 anything but one JSON object on standard output.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import itertools
import json
import math
import os
import shutil
import tempfile
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

from flight.app import cli
from flight.app import flight as flown
from flight.app.accepted_config import requested_config
from flight.app.run import RunRequest, RunResult
from flight.link.telemetry.log import SUFFIX
from ground import samples
from ground.commands import COMMANDS as GROUND_COMMANDS
from ground.commands import camera as camera_command
from ground.watch import answers
from knightcube.errors import UsageError
from sim_hal.faults.catalogue import CATALOGUE
from tests.studies.fuzz.harness import Finding
from tests.studies.fuzz.interrupted import Disturbance, disturbed
from tests.studies.fuzz.logs import hostile, split
from tests.studies.fuzz.mutation import Draw, chance, damage, integer
from tests.studies.fuzz.vocabulary import FLIGHT, NUMBERS, PATHS, RIGHT, WORDS
from tests.support.furnishings import Listener, answer, furnish

_COMMANDS = {
    name: purpose
    for name, purpose in (cli.COMMANDS | GROUND_COMMANDS).items()
    if name not in {"console", "files", "gateway"}  # they serve, or wait for a link, until they are ended
}
_DRAWN_EVERY = 200
_FLOWN_S = 0.075
_FRAMES = 2
_DISTURBED = 0.3


class Arguments:
    """The target."""

    def __init__(self) -> None:
        held = Path(tempfile.mkdtemp())
        weakref.finalize(self, shutil.rmtree, held, ignore_errors=True)
        self._folder, self._made = held / "inside" / "work", held / "made"
        self._made.mkdir()
        self._folder.mkdir(parents=True)
        with contextlib.redirect_stdout(io.StringIO()):
            furnish(self._made)
        self._files = {path.name for path in self._made.iterdir() if path.is_file()}
        self._runs = {path.parent.name for path in self._made.glob(f"*/*{SUFFIX}")}
        self._flight = Listener(self._folder / FLIGHT)
        self._answers = answer(True), answer(False)
        self._options = {name: _actions(name) for name in _COMMANDS}
        self._words: list[str] = []
        self._since_clean = 1000

    def last(self) -> str:
        """Return the last command line."""
        return repr(self._words)

    def attempt(self, draw: Draw) -> Counter[str]:
        """Type one command line."""
        self._words = words = self._command_line(draw)
        self._flight.will_say(self._reply(draw))
        self._since_clean += 1
        if self._since_clean >= 200:
            self._since_clean = 0
            shutil.rmtree(self._folder, ignore_errors=True)
            shutil.copytree(self._made, self._folder)
        if chance(draw, 0.25):
            self._spoil(draw, words)
        name = words[0] if words and words[0] in _COMMANDS else "no command"
        if chance(draw, _DISTURBED):
            disturbance = Disturbance.drawn(draw)
            self._words = [*words, repr(disturbance)]
            status = disturbed(lambda: _typed_here(words, self._folder), disturbance)
            kind = disturbance.number.name if disturbance.number is not None else disturbance.output
            return Counter(["disturbed", kind, f"{kind}, status {status}"])
        status, output, complaint = _typed(words, self._folder, drawn=integer(draw, 1, _DRAWN_EVERY) == 1)
        if status not in {0, 1, 2}:
            raise Finding(f"status {status}")
        if "Traceback" in complaint or (status == 2 and not complaint.strip()):
            raise Finding(f"status {status} with: {complaint[-300:]!r}")
        if status == 0 and "--json" in words and not any(map(_asks_for_help, words)):
            try:
                json.loads(output)
            except ValueError as error:
                raise Finding(f"--json gave {output[:100]!r}") from error
        return Counter([f"status {status}", name, f"{name}, status {status}"])

    def _command_line(self, draw: Draw) -> list[str]:
        names = list(_COMMANDS)
        name = names[integer(draw, 0, len(names) - 1)]
        share, lines = RIGHT[name]
        right = chance(draw, share)
        if right:
            words = _right_line(draw, lines)
            if chance(draw, 0.5):
                return [name, *words]
        else:
            words = self._random_line(draw, name)
        for _ in range(integer(draw, 0, 2) if chance(draw, 0.4) else 0):
            words.insert(integer(draw, 0, len(words)), _anything(draw))
        if words and chance(draw, 0.1):
            del words[integer(draw, 0, len(words) - 1)]
        if words and chance(draw, 0.1):
            at = integer(draw, 0, len(words) - 1)
            spoilt = damage(draw, os.fsencode(words[at])).replace(b"\0", b"?")
            words[at] = os.fsdecode(spoilt)
        return [name, *words] if right or chance(draw, 0.97) else words

    def _random_line(self, draw: Draw, name: str) -> list[str]:
        words: list[str] = []
        for action in self._options[name]:
            wanted = 0.85 if not action.option_strings else 0.12
            if chance(draw, wanted):
                words += _words_of(draw, action)
        return words

    def _reply(self, draw: Draw) -> bytes:
        """Return what a flight says this time: mostly an answer."""
        fate = draw.random()
        reply = self._answers[integer(draw, 0, 1)]
        if fate < 0.8:
            return reply
        return hostile(draw, reply) if fate < 0.9 else damage(draw, reply)

    def _spoil(self, draw: Draw, words: list[str]) -> None:
        """Put a damaged copy in the place of the first file, or folder of a run, that is named."""
        for index, word in enumerate(words):
            if word in self._files:
                words[index] = f"spoilt{Path(word).suffix}"
                data = (self._made / word).read_bytes()
                (self._folder / words[index]).write_bytes(_damaged(draw, data))
                return
            if word in self._runs:
                words[index] = "spoilt"
                shutil.rmtree(self._folder / words[index], ignore_errors=True)
                shutil.copytree(self._made / word, self._folder / words[index])
                paths = sorted((self._folder / words[index]).iterdir())
                path = paths[integer(draw, 0, len(paths) - 1)]
                path.write_bytes(_damaged(draw, path.read_bytes(), path.suffix == SUFFIX))
                return


def _damaged(draw: Draw, data: bytes, log: bool = False) -> bytes:
    """Return a file's content with damage, half of it in the beginning; in a log, wrong values too."""
    if log and chance(draw, 0.7):
        packets = split(data)
        for _ in range(integer(draw, 1, 10)):
            at = integer(draw, 0, len(packets) - 1)
            packets[at] = hostile(draw, packets[at])
        return b"".join(packets)
    for _ in range(integer(draw, 1, 3)):
        head = len(data) if chance(draw, 0.5) else 200
        data = damage(draw, data[:head]) + data[head:]
    return data


def _right_line(draw: Draw, lines: tuple[str, ...]) -> list[str]:
    """Return the words of a right command line, mostly with other numbers."""
    words = lines[integer(draw, 0, len(lines) - 1)].split()
    for index, word in enumerate(words):
        if word == "FAULT":
            words[index] = _fault(draw)
        elif word.replace("-", "").replace(".", "").isdigit() and "-" not in word[1:] and chance(draw, 0.3):
            value = float(word)
            words[index] = f"{value * draw.uniform(0.5, 1.5):.4g}" if "." in word else f"{value + 1:g}"
    return words


def _fault(draw: Draw) -> str:
    """Return a fault as it is written, seldom a damaged one."""
    names = list(CATALOGUE)
    fault = f"{names[integer(draw, 0, len(names) - 1)]} @ {draw.uniform(0.0, 0.05):.3f} for 0.02"
    spoilt = damage(draw, fault.encode()).replace(b"\0", b"?")
    return os.fsdecode(spoilt) if chance(draw, 0.3) else fault


_made_parser, _fly, _frames = cli._parser, flown.fly, camera_command._frames
_DRAWERS = tuple(f"ground.report.{name}" for name in ("draw", "draw_both", "draw_fit", "draw_path"))


@functools.cache
def _parser_of(command: str) -> argparse.ArgumentParser:
    return _made_parser([command])


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser that was made for such a command line before: none of them changes it."""
    return _parser_of(words[0] if words and words[0] in _COMMANDS else "")


def _typed(words: list[str], folder: Path, *, drawn: bool) -> tuple[Any, str, str]:
    """Return status, standard output and standard error of a command line typed in a folder."""
    raw = io.BytesIO()
    output = io.TextIOWrapper(raw, encoding="utf-8", errors="strict", write_through=True)
    complaint = io.StringIO()
    with _in_folder(folder, drawn), contextlib.redirect_stdout(output), contextlib.redirect_stderr(complaint):
        try:
            status: Any = cli.main(words)
        except SystemExit as end:
            status = 0 if end.code is None else end.code
    return status, raw.getvalue().decode(), complaint.getvalue()


def _typed_here(words: list[str], folder: Path) -> int:
    """Type a command line with this process's own streams; return its status."""
    with _in_folder(folder, drawn=False):
        return cli.main(words)


@contextlib.contextmanager
def _in_folder(folder: Path, drawn: bool) -> Iterator[None]:
    """Work in a temporary folder."""
    before = Path.cwd()
    changes: dict[str, Any] = {
        "flight.app.cli._parser": _parser,
        "flight.app.flight.fly": _briefly,
        "ground.commands.camera._frames": _few_frames,
        "ground.commands.station.answers": _few_answers,
        "ground.commands.station._PING_S": 0.0,
        "ground.watch.LogTail.silence": math.inf,
        "ground.samples._MAKERS": {name: samples._MAKERS[name] for name in ("stars", "limb")},
        "ground.samples.PIXELS": 64,
        "ground.samples.EARTH_PIXELS": 64,
    }
    if not drawn:
        changes |= dict.fromkeys(_DRAWERS, _not_drawn)
    os.chdir(folder)
    try:
        with contextlib.ExitStack() as stack:
            for name, change in changes.items():
                stack.enter_context(mock.patch(name, change))
            yield
    finally:
        os.chdir(before)


def _briefly(request: RunRequest, progress: Callable[[Any], None] | None = None) -> RunResult:
    """Fly for some control cycles; what would need the machine's clock is looked at, and refused."""
    _, config = requested_config(request)
    if request.realtime or request.devices is not None or config.simulation is None:
        raise UsageError("this is a rehearsal: nothing is flown in real time")
    return _fly(replace(request, duration=min(config.duration, _FLOWN_S)), progress)


def _few_frames(clock: Any, source: Any, exposure_ns: int, count: int) -> Iterator[Any]:
    return _frames(clock, source, exposure_ns, min(count, _FRAMES))


def _few_answers(to: str, patience: float, ended: threading.Event) -> Iterator[Any]:
    return itertools.islice(answers(to, min(patience, 0.1), ended), 2)


def _not_drawn(*order: Any) -> list[Path]:
    """Write nothing worth looking at where a picture, or a folder of them, is wanted."""
    place = Path(order[-1])
    try:
        if len(order) == 2:
            place.mkdir(parents=True, exist_ok=True)
            place /= "attitude.png"
        place.write_bytes(b"")
    except OSError as error:
        raise UsageError(f"{place}: no pictures can be written there: {error.strerror or error}") from error
    return [place]


def _actions(name: str) -> list[argparse.Action]:
    """Return what a command takes."""
    parser = _parser([name])
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
    pool = PATHS if action.type is Path else NUMBERS if action.type is not None else (*WORDS, *NUMBERS)
    # The first of the paths are what a command wants: they go the farthest.
    return pool[integer(draw, 0, len(pool) - 1 if chance(draw, 0.6) else min(8, len(pool) - 1))]


def _anything(draw: Draw) -> str:
    pool = (*PATHS, *NUMBERS, *WORDS)
    return pool[integer(draw, 0, len(pool) - 1)]


def _asks_for_help(word: str) -> bool:
    """Return whether a word is answered with text whatever else is asked: argparse takes beginnings, too."""
    short = word.startswith("-h") and set(word[1:]) == {"h"}  # "-hh" is -h twice
    return short or (len(word) > 2 and any(name.startswith(word) for name in ("--help", "--version")))
