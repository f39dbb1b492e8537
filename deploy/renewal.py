#!/usr/bin/env -S python3 -I -S
"""Updates configuration and release of a board, and supervises each update until the ground confirms it.

An update is called a renewal (docs/fly/renewal.md). The timer knightcube-renewal.timer runs `renewal.py` as
root every ten seconds. Each run reads the state, executes at most one request of the link, checks the trial
in progress, advances the command-loss timer, stores the state and ends. The state is stored before a step is
executed, and each step may be executed again. If the program is killed at any moment, either the old or the
new version is installed, and the next run continues.

The link is not trusted. The requests of the link must be regular files of limited size, and symbolic links
are not followed. The program `open_bundle.py` checks signatures and content of an artefact before anything is
installed. Time is counted only while the board has power, by a clock that no command and no time server can
set. Any Python interpreter can run this program, which needs only the standard library.
"""

from __future__ import annotations

import argparse
import dataclasses
import fcntl
import hashlib
import json
import os
import re
import shutil
import stat
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

DOWN_S = 180.0
"""Maximum continuous time (s) during which flight or link may be down in a trial."""
FIRST_CONTACT_S = 60.0
"""Time (s) that a flight must last before its note about a renewal is deleted."""
MOST_TRIES = 3
"""Maximum number of attempts at a request or a build. A killed process or a power loss ends an attempt."""
LARGEST_RECORD, LARGEST_BUNDLE = 1 << 16, 128 << 20
"""Maximum sizes (bytes) of a record (request or state) and of a bundle."""
LONGEST_TEXT = 120
"""Maximum length of a text from the link or in a report, so that the state stays below `LARGEST_RECORD`."""
READS = 3
"""Number of attempts to read a stored file, because a single failed disk access does not mean damage."""
KEPT_REPORTS, KEPT_REQUESTS = 16, 64
"""Maximum number of stored reports, and of stored names of executed requests."""
MOST_HOURS, MOST_DIGITS = 2400.0, 11
"""Longest trial (h), and maximum number of digits of the mission time (s since 1970) in a request."""
KINDS = ("configuration", "elements", "catalogue", "release")
STEPS = ("release", "configuration", "ground")
"""Versions to which the command-loss timer returns, one after the other."""
FLIGHT, LINK, SAFE = "knightcube.service", "knightcube-link.service", "knightcube-safe.service"
RESTARTS = {
    "flight": (["reset-failed", FLIGHT], ["--no-block", "restart", FLIGHT]),
    "link": (["reset-failed", LINK], ["--no-block", "restart", LINK]),
    "board": (["--no-block", "reboot"],),
}
"""Arguments of systemctl for each part that can be restarted by command."""
CONFIGURATION, RESTART = "flight.yaml", "restart"
GROUND = "ground"
"""Name of the stored configuration that install.sh accepted on the ground."""
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,63}")
# Name of a request: key, frame counter, first 16 bits and sequence count of the command's packet.
_REQUEST = re.compile(r"\d{1,5}-\d{1,30}-\d{1,5}-\d{1,5}")
_DAMAGED = (ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RecursionError)


class Refused(Exception):
    """Raised for a request that cannot be executed. The error text states the reason."""


@dataclasses.dataclass
class Trial:
    """Trial of a renewal, an update of configuration or release.

    Attributes:
        what: part of the software that is renewed, `configuration` or `release`.
        kind: kind of the signed artefact, one of `KINDS`.
        version: signed version of the artefact.
        request: name of the request that began the trial.
        old: name of the previous configuration (stored copy) or release.
        new: name of the new configuration or release; an empty text until a release is built.
        stage: stage of the trial: `install`, `fly` or `revert`.
        left_s: remaining powered-on time (s) of the board in which the ground must confirm the renewal.
        despite_faults: whether the trial continues after the flight has reported a fault.
        before: release to which the link `previous` pointed before the trial.
        session: identifier of the link process at the installation; faults recorded by this process are
            ignored.
        down_s: time (s) since the flight and the link process were last both active.
        tries: number of attempts to install.
        problem: reason for the return to the previous version.
    """

    what: str
    kind: str
    version: int
    request: str
    old: str
    new: str
    stage: str
    left_s: float
    despite_faults: bool
    before: str = ""
    session: str = ""
    down_s: float = 0.0
    tries: int = 0
    problem: str = ""


@dataclasses.dataclass
class State:
    """Stored state of the renewal program.

    Attributes:
        number: number of this record; the copy with the higher number is used.
        handled: names of the newest executed requests.
        versions: highest confirmed version of each kind of artefact.
        begun: number of attempts at the unfinished request, by its name.
        previous: name of the configuration that flew before the present one.
        bad: names of the releases that failed a trial.
        trial: open trial.
        returning: kind, target, replaced version, request, command and text of an unfinished return.
        reports: newest reports, each a list of number, request, result, name and text.
        note: text that the flight reports as an event at its next start.
        note_s: time (s) for which the flight software has run since the note was made.
        boot: the kernel's boot identifier at the last run.
        at: time (s) from boot to the last run.
        frames: number of authentic frames in the link's last record.
        limit_s: interval (s) of the command-loss timer; 0 disables the timer.
        silent_s: powered-on time (s) of the board since the last authentic frame.
        steps: number of executed steps of the command-loss timer.
    """

    number: int = 0
    handled: list[str] = dataclasses.field(default_factory=list)
    begun: dict[str, int] = dataclasses.field(default_factory=dict)
    versions: dict[str, int] = dataclasses.field(default_factory=dict)
    previous: str = ""
    bad: list[str] = dataclasses.field(default_factory=list)
    trial: Trial | None = None
    returning: list[str] = dataclasses.field(default_factory=list)
    reports: list[list[Any]] = dataclasses.field(default_factory=list)
    note: str = ""
    note_s: float = 0.0
    boot: str = ""
    at: float = 0.0
    frames: str = ""
    limit_s: float = 0.0
    silent_s: float = 0.0
    steps: int = 0


def encoded(values: object) -> bytes:
    """Return a record: values as a line of JSON, and the CRC-32 of this line."""
    line = json.dumps(values, sort_keys=True).encode() + b"\n"
    return line + b"%08x\n" % zlib.crc32(line)


def decoded(data: bytes) -> Any:
    """Return the values of a record. Raises ValueError for a damaged record."""
    line, end, crc = data.partition(b"\n")
    if crc != b"%08x\n" % zlib.crc32(line + end):
        raise ValueError("its checksum is wrong")
    return json.loads(line)


def state_of(values: dict[str, Any]) -> State:
    """Return the state from the values of a record. Raises an exception of `_DAMAGED` for invalid values."""
    trial = values["trial"] and Trial(**_known(Trial, values["trial"]))
    return State(**{**_known(State, values), "trial": trial})


def _known(shape: type, values: dict[str, Any]) -> dict[str, Any]:
    """Return `values` without attributes that the class `shape` lacks, such as those of a later version."""
    return {name: value for name, value in values.items() if name in shape.__annotations__}


def open_beneath(folder: Path, parts: Sequence[str], most: int) -> BinaryIO:
    """Open a regular file of at most `most` bytes below a folder without following links. Raises OSError."""
    place = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        for part in parts[:-1]:
            inner = os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=place)
            os.close(place)
            place = inner
        flags = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
        file = open(os.open(parts[-1], flags, dir_fd=place), "rb")  # noqa: SIM115 - the caller closes it
    finally:
        os.close(place)
    found = os.fstat(file.fileno())
    if not stat.S_ISREG(found.st_mode) or found.st_size > most:
        file.close()
        raise OSError(f"{parts[-1]} is not a regular file of at most {most} bytes")
    return file


def read_file(path: Path) -> bytes:
    """Return the content of a file, after at most `READS` attempts. Raises OSError."""
    for _ in range(READS - 1):
        with suppress(OSError):
            return path.read_bytes()
    return path.read_bytes()


def replace_file(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Replace a file atomically and sync it to disk. Raises OSError."""
    beside = path.with_name(f".{path.name}.part")
    beside.unlink(missing_ok=True)
    try:
        with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
            os.fchmod(file.fileno(), mode)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError:  # an incomplete file may have filled the disk
        beside.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Sync the directory entries of a folder to disk. Raises OSError."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class Board:
    """Files and services of a board.

    Attributes:
        root: root folder of the board's file system.
        prefix: folder of the installed software.
        link: state folder of the link.
        own: state folder of this program.
        kept: folder of the stored copies of configurations and catalogues.
        configuration: path of the configuration that the flight reads.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.prefix = root / "opt/knightcube"
        self._settings = root / "etc/knightcube"
        self._units = root / "etc/systemd/system"
        self.link = root / "var/lib/knightcube-link"
        self.own = root / "var/lib/knightcube-renewal"
        self.kept = self.own / "kept"
        self.configuration = self._settings / CONFIGURATION

    def roots(self) -> list[Path]:
        """Return the paths of the existing copies of the first root metadata."""
        copies = (self._settings / "root.json", self.prefix / "share/root.json")
        return [path for path in copies if path.is_file()]

    def _set(self) -> dict[str, Path]:
        """Return the installed path of each file of a stored configuration, `CONFIGURATION` last."""
        units = ("knightcube", "knightcube-safe", "knightcube-link")
        return {
            **{f"{unit}.conf": self._units / f"{unit}.service.d/board.conf" for unit in units},
            f"{CONFIGURATION}.sha256": self._settings / f"{CONFIGURATION}.sha256",
            CONFIGURATION: self.configuration,
        }

    def keep(self, name: str, folder: Path | None = None) -> str:
        """Store a copy of the installed configuration, or of the configuration in `folder`.

        Returns the name of the copy: `name` or, if it is empty, the SHA-256 of the configuration. Returns an
        empty text for a configuration that cannot be read. Raises OSError if the copy cannot be stored.
        """
        files = {one: (path if folder is None else folder / one) for one, path in self._set().items()}
        try:
            contents = {one: read_file(path) for one, path in files.items() if path.is_file()}
            name = name or hashlib.sha256(contents[CONFIGURATION]).hexdigest()
        except (OSError, KeyError):
            return ""
        place, beside = self.kept / name, self.kept / f".{name}.part"
        if self.stored(name) != contents:
            shutil.rmtree(beside, ignore_errors=True)
            beside.mkdir(parents=True)
            for one, data in contents.items():
                replace_file(beside / one, data)
            sums = {one: hashlib.sha256(data).hexdigest() for one, data in contents.items()}
            replace_file(beside / "sums", encoded(sums))
            shutil.rmtree(place, ignore_errors=True)
            beside.replace(place)
            sync_folder(self.kept)
        return name

    def stored(self, name: str) -> dict[str, bytes] | None:
        """Return the files of a stored configuration, or None if a file is missing or damaged."""
        with suppress(OSError, *_DAMAGED):
            sums = decoded(read_file(self.kept / name / "sums"))
            contents = {one: read_file(self.kept / name / one) for one in sums}
            if all(hashlib.sha256(data).hexdigest() == sums[one] for one, data in contents.items()):
                return contents
        return None

    def install(self, name: str) -> None:
        """Install a stored configuration. Raises OSError, and Refused if the stored copy is damaged."""
        contents = self.stored(name)
        if contents is None:
            raise Refused(f"the kept configuration {name[:12]} is missing or damaged")
        for one, path in self._set().items():
            if one in contents:
                path.parent.mkdir(parents=True, exist_ok=True)
                with suppress(OSError):  # an unreadable file is replaced
                    if path.read_bytes() == contents[one]:
                        continue
                replace_file(path, contents[one])

    def linked(self, link: str) -> str:
        """Return the target name of a symbolic link, or an empty text if none exists. Raises OSError."""
        with suppress(FileNotFoundError):
            return Path(os.readlink(self.prefix / link)).name
        return ""

    def release(self, link: str) -> str:
        """Return the name of the release to which the symbolic link `link` points, or an empty text."""
        with suppress(OSError):
            name = self.linked(link)
            if name and (self.prefix / "releases" / name / "manifest").is_file():
                return name
        return ""

    def point(self, link: str, name: str) -> None:
        """Let the symbolic link `link` point to a release. Raises OSError."""
        path = self.prefix / link
        beside = path.with_name(f".{link}.part")
        beside.unlink(missing_ok=True)
        beside.symlink_to(Path("releases") / name)
        beside.replace(path)
        sync_folder(self.prefix)

    def remove(self, release: str) -> None:
        """Remove a release, beginning with its manifest, without which it is incomplete. Raises OSError."""
        path = self.prefix / "releases" / release
        (path / "manifest").unlink(missing_ok=True)
        shutil.rmtree(path)

    def python(self, release: str) -> Path:
        """Return the Python interpreter of a release."""
        return self.prefix / "releases" / release / "venv/bin/python"

    def builder(self, release: str) -> str:
        """Return the Python interpreter with which a release was built."""
        with suppress(OSError, UnicodeDecodeError):
            settings = (self.prefix / "releases" / release / "venv/pyvenv.cfg").read_text(encoding="utf-8")
            for line in settings.splitlines():
                if line.startswith("executable = "):
                    return line.removeprefix("executable = ")
        return "python3"

    def run(self, words: Sequence[object], limit_s: float = 1800.0) -> subprocess.CompletedProcess[str]:
        """Run a program in an isolated environment; a program that cannot be run has the status 127."""
        command = [str(word) for word in words]
        try:
            return subprocess.run(
                command, cwd="/", capture_output=True, errors="replace", timeout=limit_s, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return subprocess.CompletedProcess(command, 127, "", f"{type(error).__name__}: {error}")

    def restart(self, *parts: str) -> None:
        """Request restarts of `parts` after this run, by default of flight and link. Raises OSError."""
        path, wanted = self.own / RESTART, parts or ("flight", "link")
        with suppress(FileNotFoundError):
            wanted += tuple(path.read_text(encoding="ascii", errors="replace").split())
        replace_file(path, " ".join(dict.fromkeys(wanted)).encode())

    def restart_parts(self) -> None:
        """Restart the requested parts (flight, link, board); a damaged request restarts flight and link.

        The request is deleted after the restart, so that it is not lost if this program is killed. A request
        to restart the board is deleted before the restart, so that it is not repeated after each boot. Raises
        OSError.
        """
        path = self.own / RESTART
        if not path.exists():
            return
        parts = path.read_text(encoding="ascii", errors="replace").split()
        if not parts or not set(parts) <= set(RESTARTS):
            parts = ["flight", "link"]
        if "board" in parts:
            path.unlink()
            sync_folder(self.own)
        self.run(["systemctl", "daemon-reload"], 60.0)
        for words in (words for part in parts for words in RESTARTS[part]):
            self.run(["systemctl", *words], 60.0)
        path.unlink(missing_ok=True)

    def active(self, unit: str) -> bool:
        """Return whether a systemd unit is active."""
        return self.run(["systemctl", "is-active", "--quiet", unit], 60.0).returncode == 0

    def flown_release(self, unit: str) -> str:
        """Return the name of the release whose Python runs a unit, or an empty text."""
        with suppress(OSError, ValueError):
            pid = int(self.run(["systemctl", "show", "--property=MainPID", "--value", unit], 60.0).stdout)
            first = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0", 1)[0].decode()
            parts = Path(first).parts
            if "releases" in parts[:-1]:
                return parts[parts.index("releases") + 1]
        return ""


class Renewal:
    """One run of the renewal program: requests, trial and command-loss timer."""

    def __init__(self, board: Board, clock: Callable[[], float], boot: str) -> None:
        """Read the state of `board`. `clock` returns the time (s) since boot; `boot` identifies the boot."""
        self._board, self._clock, now = board, clock, clock()
        self._state = state = self._read()
        self._elapsed = now - state.at if state.boot == boot and now >= state.at else now
        state.boot, state.at = boot, now
        self._contact = self._read_contact()

    def _read(self) -> State:
        """Return the newest undamaged copy of the state, or an empty state."""
        found = []
        for copy in ("a", "b") * READS:
            with (
                suppress(OSError, *_DAMAGED),
                open_beneath(self._board.own, [f"state.{copy}"], LARGEST_RECORD) as file,
            ):
                found.append(state_of(decoded(file.read())))
        return max(found, key=lambda state: state.number, default=State())

    def _save(self) -> None:
        """Store the state and the reports for the link. Raises OSError if no copy can be written."""
        state = self._state
        state.number += 1
        data, problems = encoded(dataclasses.asdict(state)), list[OSError]()
        for copy in ("a", "b"):
            try:
                replace_file(self._board.own / f"state.{copy}", data, 0o600)
            except OSError as error:
                problems.append(error)
        if len(problems) == 2:
            raise problems[1]
        trial = state.trial
        text = f"{trial.kind} {trial.version}: {trial.stage}, {trial.left_s:.0f} s left" if trial else ""
        shown = {"reports": state.reports, "trial": text, "note": state.note}
        try:
            replace_file(self._board.own / "status", encoded(shown))
        except OSError as error:  # the step continues, and the next step writes the status again
            sys.stderr.write(f"renewal: cannot write the status: {error}\n")

    def _store(self, **changes: Any) -> None:
        """Change and store the state. Raises OSError if no copy can be written; then nothing is changed."""
        before = {name: getattr(self._state, name) for name in changes}
        vars(self._state).update(changes)
        try:
            self._save()
        except OSError:
            vars(self._state).update(before)
            raise

    def _report(self, request: str, result: str, name: str, text: str) -> None:
        """Add a report for the link, and a line in the journal."""
        number = 1 + (self._state.reports[-1][0] if self._state.reports else 0)
        report = [number, request, result, name[:LONGEST_TEXT], text[:LONGEST_TEXT]]
        self._state.reports = [*self._state.reports, report][-KEPT_REPORTS:]
        sys.stderr.write(f"renewal: {name} {result}: {text}\n")

    def _read_contact(self) -> dict[str, Any]:
        """Return the link's record of its contact with the ground, or an empty record if it is unreadable."""
        with (
            suppress(OSError, *_DAMAGED),
            open_beneath(self._board.link, ["renewal", "contact"], LARGEST_RECORD) as file,
        ):
            contact = decoded(file.read())
            texts = {name: str(contact[name])[:LONGEST_TEXT] for name in ("session", "frames", "fault")}
            return {**texts, "limit_s": float(contact["limit_s"])}
        return {}

    def step(self) -> None:
        """Continue an interrupted step, execute one request and check the trial. Raises OSError."""
        # A trial whose installation ends in this step is not checked, because the units must first restart.
        trial = self._state.trial
        judged = trial if trial is not None and trial.stage == "fly" else None
        if trial is not None:
            self._continue()
        if self._state.returning:
            self._return()
        if name := self._next_request():
            self._obey(name)
        if judged is not None and self._state.trial is judged and judged.stage == "fly":
            self._judge()
        if self._state.trial is None or self._state.trial.stage != "install":
            shutil.rmtree(self._board.own / "staging", ignore_errors=True)
        self._remove_failed()
        self._count_silence()
        self._age_note()
        self._save()

    def accept(self, what: str) -> None:
        """Store the accepted configuration, and end a trial or a return that would undo the installation."""
        state, trial, ended = self._state, self._state.trial, list[str]()
        if not self._board.keep(GROUND):
            raise OSError(f"{self._board.configuration} cannot be read")
        if state.returning and (what == "release" or state.returning[0] != "release"):
            ended, state.returning = state.returning[3:5], []
        if trial is not None and what in {"release", trial.what}:
            ended, state.trial = [trial.request, "activate"], None
            if trial.what == "configuration":
                state.previous = trial.old
            elif trial.old:
                # install.sh keeps the release `current` as the fallback, so this must be a confirmed release.
                self._board.point("current", trial.old)
        if ended:
            self._report(
                ended[0], "failed", ended[1], "install.sh was run: the version that it installed is kept"
            )
            self._save()

    def _next_request(self) -> str:
        """Delete the executed requests, and return the name of the first other request, or an empty text.

        The requests are executed in ascending order of the key and of the frame counter in their names.
        """
        folder, names, handled = self._board.link / "renewal", list[str](), self._state.handled
        with suppress(OSError):
            names = [one for one in os.listdir(folder) if _REQUEST.fullmatch(one) and one not in handled]
            for name in handled:
                (folder / name).unlink(missing_ok=True)
            sync_folder(folder)
            # The counter of a new key begins at 0, so a later request can have the name of a deleted one.
            self._state.handled = []
        return min(names, key=lambda name: [int(number) for number in name.split("-")], default="")

    def _obey(self, name: str) -> None:
        """Execute a request, in at most `MOST_TRIES` attempts, and report the reason if it is refused."""
        state = self._state
        state.begun = {name: state.begun.get(name, 0) + 1}
        self._save()  # otherwise a request that stops the board would be repeated forever
        state.handled = [*state.handled, name][-KEPT_REQUESTS:]
        request: dict[str, Any] = {}
        with (
            suppress(OSError, *_DAMAGED),
            open_beneath(self._board.link, ["renewal", name], LARGEST_RECORD) as file,
        ):
            request = dict(decoded(file.read()))
        word, kind = str(request.get("do", "")), str(request.get("kind", ""))
        try:
            if state.begun[name] > MOST_TRIES:
                raise Refused(
                    f"the board or the renewal program stopped {MOST_TRIES} times during this request"
                )
            if word == "restart":
                self._restart(name, str(request["part"]))
            elif kind in KINDS and word == "activate":
                self._activate(name, kind, request)
            elif kind in KINDS and word == "confirm":
                self._confirm(name, kind)
            elif kind in KINDS and word == "withdraw":
                self._withdraw(name, kind)
            else:
                raise Refused("the request is damaged")
        except (Refused, OSError, *_DAMAGED) as error:
            self._report(name, "failed", word or "request", str(error) or type(error).__name__)
        state.begun = {}

    def _restart(self, name: str, part: str) -> None:
        """Store the request as executed, so that it is never repeated, and restart flight, link or board."""
        if part not in RESTARTS:
            raise Refused("the request is damaged")
        self._report(name, "completed", "restart", f"{part} is restarted")
        self._save()
        self._board.restart(part)

    def _activate(self, name: str, kind: str, request: dict[str, Any]) -> None:
        """Check a bundle and begin its trial. Raises Refused for an invalid bundle, and OSError."""
        state, board = self._state, self._board
        if state.returning:
            raise Refused("the return to an earlier version is not finished: activate again later")
        if state.trial is not None:
            raise Refused(
                f"{state.trial.kind} {state.trial.version} is on trial: confirm or withdraw it first"
            )
        hours = float(request["hours"])
        if not 0.0 < hours <= MOST_HOURS:
            raise Refused(f"{hours:g} h: choose a trial of more than 0 and at most {MOST_HOURS:g} h")
        staging = board.own / "staging"
        shutil.rmtree(staging, ignore_errors=True)
        staging.mkdir(parents=True, mode=0o700)
        self._copy_bundle(kind, str(request["name"]), str(request["sum"]), staging / "bundle")
        utc = "" if "utc" not in request else str(int(request["utc"]))
        if len(utc) > MOST_DIGITS:
            raise Refused("the request is damaged")
        releases = filter(None, (board.release("current"), board.release("previous")))
        facts = self._opened(kind, staging, releases, board.own / "trusted", utc)
        version = int(facts["version"])
        if version <= state.versions.get(kind, 0) and not facts["back"]:
            raise Refused(
                f"{kind} {version} is not newer than {state.versions[kind]}: "
                "sign a newer version, or sign this one with --back"
            )
        left_s, despite, before = 3600.0 * hours, bool(request["despite_faults"]), board.release("previous")
        session = str(self._contact.get("session", ""))
        if kind == "release":
            # If the current release is incomplete, the previous release runs, also after a failed trial.
            old, new, what = board.release("current") or board.release("previous"), "", "release"
            (staging / "artefact").unlink()  # the check of the built release needs the space
            shutil.rmtree(staging / "unpacked")
            os.sync()  # the sources must be on disk before the trial is stored
        else:
            old, what = board.keep(""), "configuration"
            if kind == "catalogue":
                index = board.kept / f"index-{facts['sha256']}"
                replace_file(index, (staging / "artefact").read_bytes())
            new = board.keep("", staging / "set")
            if new == old:
                raise Refused(f"this {kind} is in use already")
        trial = Trial(what, kind, version, name, old, new, "install", left_s, despite, before, session)
        self._store(trial=trial)
        self._continue()

    def _copy_bundle(self, kind: str, name: str, expected: str, path: Path) -> None:
        """Copy the selected bundle of the link. Raises Refused if the bundle's SHA-256 is not `expected`."""
        if not _NAME.fullmatch(name):
            raise Refused(f"{name[:64]!r} is not the name of a bundle")
        digest = hashlib.sha256()
        parts = ["files", "chosen", kind, name]
        with open_beneath(self._board.link, parts, LARGEST_BUNDLE) as file, path.open("wb") as copy:
            copied = 0
            while (data := file.read(1 << 20)) and copied <= LARGEST_BUNDLE:
                digest.update(data)
                copied += copy.write(data)
        if digest.hexdigest() != expected:
            raise Refused(f"{name} is not the file that was activated: its SHA-256 is {digest.hexdigest()}")

    def _opened(
        self, kind: str, folder: Path, releases: Iterable[str], trusted: Path, utc: str = ""
    ) -> dict[str, Any]:
        """Return the result of `open_bundle.py` at the mission time `utc` (s), which is empty if unknown.

        The content is written to `folder`. Raises Refused if the program fails with all `releases`.
        """
        board, problems = self._board, list[str]()
        program = Path(__file__).resolve().with_name("open_bundle.py")
        kept = "/" / board.kept.relative_to(board.root)
        # One copy of the root metadata and one release may be damaged, so all combinations are tried.
        for release, root in ((release, root) for release in releases for root in board.roots()):
            for left in ("unpacked", "set", "source"):
                shutil.rmtree(folder / left, ignore_errors=True)
            words = [program, trusted, root, board.own / "staging/bundle", kind, folder]
            words += [board.configuration, kept, utc]
            done = board.run([board.python(release), "-I", "-B", *words], 600.0)
            if done.returncode == 0:
                return dict(json.loads(done.stdout))
            problems += done.stderr.strip().splitlines()[-1:] or [f"status {done.returncode}"]
        raise Refused(
            [*problems, "no release or no root.json is installed and readable: run deploy/install.sh"][0]
        )

    def _confirm(self, name: str, kind: str) -> None:
        """End the trial and keep the new version. Raises Refused if the trial cannot be confirmed."""
        state, trial, board = self._state, self._state.trial, self._board
        if trial is None or trial.stage != "fly" or trial.kind != kind:
            raise Refused(f"no {kind} is on trial")
        if board.active(SAFE) or not (board.active(FLIGHT) and board.active(LINK)):
            raise Refused("flight or link is not running: confirm the trial when both run")
        if other := self._other_release(trial):
            raise Refused(f"flight or link runs release {other} instead")
        previous = trial.old if trial.what == "configuration" else state.previous
        self._store(trial=None, previous=previous, versions={**state.versions, kind: trial.version})
        text = f"{kind} {trial.version} is kept"
        self._report(trial.request, "completed", "activate", text)
        self._report(name, "completed", "confirm", text)
        with suppress(OSError):  # if this fails, the end of the step stores the reports
            self._save()
        self._tidy()

    def _withdraw(self, name: str, kind: str) -> None:
        """Restore the version before the trial, or if there is no trial, the previous one. Raises Refused."""
        trial = self._state.trial
        if trial is None:
            what = "release" if kind == "release" else "configuration"
            if not self._go_back(what, name, "withdraw", f"the ground withdrew the present {what}"):
                raise Refused(f"there is no previous {what}")
            return
        if trial.kind != kind:
            raise Refused(f"{trial.kind} {trial.version} is on trial, not a {kind}")
        self._begin_revert("the ground withdrew it")
        self._report(name, "completed", "withdraw", f"{kind} {trial.version} is withdrawn")

    def _continue(self) -> None:
        """Execute the present stage of the trial, which an interrupted run may have begun."""
        trial = self._state.trial
        assert trial is not None
        try:
            if trial.stage == "install":
                self._install(trial)
            elif trial.stage == "revert":
                self._revert(trial)
        except (Refused, OSError) as error:
            if trial.stage == "install":
                self._begin_revert(f"the artefact cannot be installed: {error}")
            else:  # the new version stays installed until a later run reverts it
                sys.stderr.write(f"renewal: cannot revert yet: {error}\n")

    def _install(self, trial: Trial) -> None:
        """Install the new version and request a restart. Raises Refused or OSError if this fails."""
        board = self._board
        if trial.what == "configuration":
            board.install(trial.new)
        else:
            if not trial.new:
                trial.tries += 1
                if trial.tries > MOST_TRIES:
                    raise Refused(f"the build of the release did not end {MOST_TRIES} times")
                self._save()
                trial.new = self._built(trial.old)
                self._save()
            if trial.new == trial.old:
                raise Refused("this release is in use already")
            board.point("previous", trial.old)
            board.point("current", trial.new)
        board.restart()  # if killed before the state is stored, this step is repeated
        trial.stage, now = "fly", self._clock()
        # Flight and link are not down during a build, which takes up to half an hour.
        self._state.silent_s, self._state.at = self._state.silent_s + now - self._state.at, now
        text = f"{trial.kind} {trial.version} is installed, trial of {trial.left_s / 3600.0:g} h"
        self._report(trial.request, "started", "activate", text)
        self._save()

    def _built(self, old: str) -> str:
        """Build the release of the bundle beside the release `old`, and return its name.

        Raises Refused if this fails, and OSError.
        """
        board, source = self._board, self._board.own / "staging/source"
        wheels = ["--wheels", source / "wheels"] if (source / "wheels").is_dir() else ["--reuse", old]
        words = [board.builder(old), "-I", source / "deploy/build_release.py", board.prefix, "build"]
        done = board.run([*words, "--python", board.builder(old), *wheels])
        if done.returncode != 0:
            raise Refused((done.stderr.strip().splitlines() or ["the build failed"])[-1])
        name = done.stdout.split()[-1]
        try:
            self._check_built(name)
        except (Refused, OSError):
            with suppress(OSError):  # a release in use was not built again, and is kept
                if name not in {board.linked("current"), board.linked("previous")}:
                    board.remove(name)
            raise
        return name

    def _check_built(self, name: str) -> None:
        """Raise Refused if a release refuses the present configuration or cannot open bundles."""
        board = self._board
        dropin = Path(__file__).resolve().with_name("board_dropin.py")
        checked = board.run([board.python(name), "-I", "-B", dropin, board.configuration], 120.0)
        if checked.returncode != 0:
            raise Refused(f"the release refuses the present configuration: {checked.stderr.strip()[-60:]}")
        again = board.own / "staging/again"
        shutil.rmtree(again, ignore_errors=True)
        again.mkdir()
        try:
            self._opened("release", again, [name], again / "trusted")
        except Refused as error:  # with two such releases, no bundle could be opened any more
            raise Refused(f"the release cannot open bundles: {error}") from error

    def _begin_revert(self, problem: str) -> None:
        """Return to the version before the trial."""
        trial = self._state.trial
        assert trial is not None
        trial.stage, trial.problem = "revert", problem[: 4 * LONGEST_TEXT]
        self._save()
        self._continue()

    def _revert(self, trial: Trial) -> None:
        """Install the trial's old version, request a restart and end the trial. Raises OSError."""
        state, board, end = self._state, self._board, "the previous version is in use"
        if trial.what == "configuration":
            for name in (trial.old, GROUND):
                with suppress(Refused):
                    board.install(name)
                    break
            else:
                end = "it stays, because no stored configuration is intact"
        else:
            if trial.new and trial.new != trial.old:
                state.bad = [*(name for name in state.bad if name != trial.new), trial.new][-KEPT_REPORTS:]
            if trial.old:
                board.point("current", trial.old)
            if trial.before:
                board.point("previous", trial.before)
        text = f"{trial.kind} {trial.version}: {trial.problem}; {end}"
        state.trial, state.note, state.note_s = None, text, 0.0
        self._report(trial.request, "failed", "activate", text)
        if trial.what == "configuration" or trial.new:  # without a built release, no restart is necessary
            board.restart()  # if killed before the state is stored, this step is repeated
        self._save()
        with suppress(OSError):
            self._tidy_kept()

    def _judge(self) -> None:
        """End the trial if the new version fails, or if the ground has not confirmed it in time."""
        trial, board, contact = self._state.trial, self._board, self._contact
        assert trial is not None
        up = board.active(FLIGHT) and board.active(LINK)
        trial.down_s = 0.0 if up else trial.down_s + self._elapsed
        trial.left_s -= self._elapsed
        other = self._other_release(trial) if up else ""
        if board.active(SAFE):
            self._begin_revert("the flight software ended five times in a minute")
        elif trial.down_s >= DOWN_S:
            self._begin_revert(f"flight or link did not run for {DOWN_S:.0f} s")
        elif other:
            self._begin_revert(f"flight or link runs release {other} instead")
        elif contact.get("fault") and contact["session"] != trial.session and not trial.despite_faults:
            self._begin_revert(f"the flight reported a fault: {contact['fault']}")
        elif trial.left_s <= 0.0:
            self._begin_revert("the ground did not confirm the trial")

    def _other_release(self, trial: Trial) -> str:
        """Return the release that flight or link run instead of the release on trial, or an empty text."""
        units = (FLIGHT, LINK) if trial.what == "release" else ()
        return min({*map(self._board.flown_release, units)} - {"", trial.new}, default="")

    def _go_back(self, what: str, request: str, word: str, text: str) -> bool:
        """Return to an earlier release or configuration.

        Returns False if there is no undamaged earlier version that differs from the present one.
        """
        state, board = self._state, self._board
        if what == "release":
            current, name = board.release("current"), board.release("previous")
            if not name or name == current or name in state.bad:
                return False
        else:
            name, current = GROUND if what == GROUND else state.previous, ""
            with suppress(OSError):  # the return is possible without a copy of the present configuration
                current = board.keep("")
            stored = board.stored(name) if name else None
            if stored is None or hashlib.sha256(stored[CONFIGURATION]).hexdigest() == current:
                return False
        self._store(returning=[what, name, current, request, word, text])
        self._return()
        return True

    def _return(self) -> None:
        """Execute the stored return to an earlier version, which an interrupted run may have begun."""
        state, board = self._state, self._board
        what, name, current, request, word, text = state.returning
        try:
            if what == "release":
                board.point("current", name)
                if current:
                    board.point("previous", current)
            else:
                board.install(name)
                state.previous = current
            board.restart()
        except Refused as error:
            self._report(request, "failed", word, str(error))
        except OSError as error:  # a later run tries again
            sys.stderr.write(f"renewal: cannot return yet: {error}\n")
            return
        else:
            self._report(request, "completed", word, text)
            state.note, state.note_s = text, 0.0
        state.returning = []

    def _count_silence(self) -> None:
        """Count the time without an authentic frame, and return to an earlier version after each interval."""
        state, contact = self._state, self._contact
        heard = f"{contact.get('session')} {contact.get('frames')}"
        if contact:
            state.limit_s = max(0.0, contact["limit_s"])
        if contact and contact["frames"] != "0" and heard != state.frames:
            state.frames, state.silent_s, state.steps = heard, 0.0, 0
            return
        state.silent_s += self._elapsed
        while state.limit_s > 0.0 and state.steps < len(STEPS):
            if state.silent_s < state.limit_s * (state.steps + 1):
                return
            step = STEPS[state.steps]
            state.steps += 1
            if state.trial is not None:
                self._begin_revert("no authentic frame arrived")
            what = "configuration accepted on the ground" if step == GROUND else f"previous {step}"
            text = f"no authentic frame for {state.silent_s:.0f} s: the {what} is used"
            if self._go_back(step, "", "command-loss", text):
                return
            # This step found no version to which it can return, so the next step follows at once.
            state.silent_s = max(state.silent_s, state.limit_s * (state.steps + 1))

    def _age_note(self) -> None:
        """Delete the note for the flight once the flight has been active long enough to report it."""
        state = self._state
        if state.note:
            state.note_s = state.note_s + self._elapsed if self._board.active(FLIGHT) else 0.0
            if state.note_s >= FIRST_CONTACT_S + self._elapsed:
                state.note = ""

    def _remove_failed(self) -> None:
        """Remove the releases that failed a trial, except the newest one.

        The script `fly` starts the newest one if all other releases are damaged.
        """
        board, releases = self._board, self._board.prefix / "releases"
        with suppress(OSError):
            if failed := [name for name in self._state.bad if (releases / name).is_dir()][:-1]:
                used = {board.linked("current"), board.linked("previous")}
                for name in {*failed} - used - {*map(board.flown_release, (FLIGHT, LINK))}:
                    board.remove(name)

    def _tidy(self) -> None:
        """Remove the releases and configurations to which no step returns."""
        board = self._board
        with suppress(OSError):
            named_releases = {board.linked("current"), board.linked("previous")}
            for path in (board.prefix / "releases").iterdir():
                if path.name not in named_releases:
                    board.remove(path.name)
            self._tidy_kept()

    def _tidy_kept(self) -> None:
        """Remove the stored configurations and catalogues to which no step returns. Raises OSError."""
        state, board = self._state, self._board
        texts = [(board.kept / name / CONFIGURATION) for name in (state.previous, GROUND)]
        named = b"".join(path.read_bytes() for path in (*texts, board.configuration) if path.is_file())
        for path in board.kept.iterdir():
            is_index = path.name.startswith("index-") and path.name.encode() in named
            if not is_index and path.name not in {state.previous, GROUND}:
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def boot_id() -> str:
    """Return the kernel's identification of this boot, or an empty text."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return ""


def main(words: Sequence[str]) -> int:
    """Execute one run, and return the exit status."""
    parser = argparse.ArgumentParser(description="Execute one step of the renewal (docs/fly/renewal.md).")
    parser.add_argument("--root", type=Path, default=Path("/"), help="folder of the board's files")
    parser.add_argument("--now", type=float, help="time since boot (s) to assume, for tests")
    parser.add_argument("--accepted", choices=("configuration", "release"), help="what install.sh installs")
    parser.add_argument("--restart", action="store_true", help="restart the services as requested by a run")
    options = parser.parse_args(words)
    board = Board(options.root)
    try:
        board.own.mkdir(parents=True, exist_ok=True)
        with open(board.own / "lock", "a", encoding="ascii") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | (0 if options.accepted else fcntl.LOCK_NB))
            except BlockingIOError:
                return 0  # an earlier run is still building a release
            if options.restart:
                board.restart_parts()
            else:
                now, clock = options.now, time.CLOCK_BOOTTIME
                one = Renewal(board, lambda: time.clock_gettime(clock) if now is None else now, boot_id())
                one.accept(options.accepted) if options.accepted else one.step()
    except OSError as error:
        sys.stderr.write(f"renewal: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
