"""A board with the privileged update program, signing keys, bundles, and files that represent services."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import shutil
import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self
from unittest.mock import patch

from flight.link.process.filing import decoded, encoded
from ground.commands.renewal import artefact, make_signing_keys, sign
from tests.deploy.boards import FakeBoard
from tests.deploy.scripts import ROOT, changed_testbed, script

renewal, open_bundle = script("renewal"), script("open_bundle")

LINK = "{keys: /var/lib/knightcube-link/keys, udp: '192.168.7.2:5000'}"
_SYSTEMCTL = """#!/bin/sh
echo "$*" >>"$BOARD/calls"
case "$*" in
    "is-active "*) for unit; do :; done; [ -e "$BOARD/active/$unit" ] ;;
    *MainPID*) for unit; do :; done; cat "$BOARD/pid-$unit" ;;
esac
"""


def in_process(
    main: Callable[[Sequence[str]], int], words: Sequence[object]
) -> subprocess.CompletedProcess[str]:
    """Run the program whose function is `main` in this process; return its status and outputs."""
    command, printed, complaint = [str(word) for word in words], io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(complaint):
        status = main(command)
    return subprocess.CompletedProcess(command, status, printed.getvalue(), complaint.getvalue())


_SCRIPT_BOARD: Any = renewal.Board


class _Board(_SCRIPT_BOARD):  # type: ignore[misc]  # the script is imported without types
    """Files and services of a board. The bundles are opened in the process of the test."""

    def run(self, words: Sequence[object], limit_s: float = 1800.0) -> subprocess.CompletedProcess[str]:
        """Run a program. Only the code of `open_bundle.py` runs in this process."""
        python, *options = words
        if len(options) < 3 or Path(str(options[2])).name != "open_bundle.py":
            found: subprocess.CompletedProcess[str] = super().run(words, limit_s)
            return found
        started: subprocess.CompletedProcess[str] = super().run([python, "-m", "flight", "--version"])
        return in_process(open_bundle.main, options[3:]) if started.returncode == 0 else started


class RenewedBoard:
    """A board with the release `old`, and the signing keys of its ground station.

    The privileged program runs in this process, because a separate process would spend most of its time on
    imports. If `processes` is set, the privileged program runs in a process of its own, as on a board.
    """

    processes = False

    def __init__(self, place: Path) -> None:
        """Use the files in a folder that `make` has created."""
        self.place, self.root, self.now = place, place / "root", 1000.0
        self.files = FakeBoard(self.root, place / "flight.yaml")
        self.own, self.link = self.root / "var/lib/knightcube-renewal", self.root / "var/lib/knightcube-link"
        self.config = self.root / "etc/knightcube/flight.yaml"
        self.count = 0

    @classmethod
    def make(cls, place: Path, text: str = "") -> Self:
        """Install a board with a configuration, by default the testbed's, and make the signing keys."""
        place.mkdir(exist_ok=True)
        changed_testbed(place, commands="{socket: /run/knightcube/commands}", link=LINK)
        if text:
            (place / "flight.yaml").write_text(text, encoding="utf-8")
        root_metadata = make_signing_keys(place / "signing")
        board = cls(place)
        board.config.parent.mkdir(parents=True)
        shutil.copyfile(root_metadata, board.config.parent / "root.json")
        board.files.install("old")
        systemctl = place / "bin/systemctl"
        systemctl.parent.mkdir()
        systemctl.write_text(_SYSTEMCTL, encoding="ascii")
        systemctl.chmod(0o755)
        (place / "active").mkdir()
        for unit in ("knightcube.service", "knightcube-link.service"):
            board.set_active(unit, True)
        (board.link / "renewal").mkdir(parents=True)
        return board

    @classmethod
    def copy(cls, made: RenewedBoard, place: Path) -> RenewedBoard:
        """Return a copy of a board."""
        shutil.copytree(made.place, place, symlinks=True, dirs_exist_ok=True)
        return cls(place)

    def set_active(self, unit: str, active: bool) -> None:
        """Set whether a unit of systemd is active."""
        path = self.place / "active" / unit
        path.touch() if active else path.unlink(missing_ok=True)

    def environment(self) -> dict[str, str]:
        """Return the environment of the privileged program."""
        path = f"{self.place / 'bin'}:{os.environ['PATH']}"
        return {**os.environ, "PATH": path, "BOARD": str(self.place)}

    def words(self) -> list[str]:
        """Return the command line of one step of the privileged program."""
        program = self.files.prefix / "bin/renewal.py"
        return [sys.executable, "-I", "-S", str(program), "--root", str(self.root), "--now", str(self.now)]

    def step(self, seconds: float = 10.0) -> str:
        """Advance the clock, run one step of the privileged program, and return its error output."""
        self.now += seconds
        return self.run()

    def run(self, *options: str) -> str:
        """Run the privileged program with options; return its error messages."""
        words = [*self.words(), *options]
        if self.processes:
            done = subprocess.run(words, env=self.environment(), capture_output=True, text=True, check=False)
        else:
            program = words.index(str(self.files.prefix / "bin/renewal.py"))
            with (
                patch.dict(os.environ, self.environment()),
                patch.multiple(renewal, Board=_Board, __file__=words[program]),
            ):
                done = in_process(renewal.main, words[program + 1 :])
        assert done.returncode == 0, done.stderr
        return done.stderr

    def bundle(self, kind: str, path: Path, version: int, *, unchecked: bool = False, **changes: Any) -> Path:
        """Sign an artefact. If `unchecked` is set, the checks of the ground are omitted."""
        options = {"back": False, "expires": None, "least": 1, "out": self.place} | changes
        data = path.read_bytes() if unchecked and path.is_file() else artefact(kind, path)
        signing = self.place / "signing"
        return sign(Namespace(folder=signing, kind=kind, version=version, **options), data)

    def put(self, bundle: Path, kind: str = "configuration") -> str:
        """Store a bundle as the link stores an uplinked bundle, and return its SHA-256 digest."""
        place = self.link / "files/chosen" / kind / bundle.name
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(bundle, place)
        return hashlib.sha256(bundle.read_bytes()).hexdigest()

    def request(self, word: str, kind: str = "configuration", **values: Any) -> str:
        """Write a request as the link does, and return the name of the request."""
        self.count += 1
        name = f"1-{self.count}-0-0"
        (self.link / "renewal" / name).write_bytes(encoded({"do": word, "kind": kind, **values}))
        return name

    def activate(self, bundle: Path, kind: str = "configuration", hours: float = 1.0, **changes: Any) -> str:
        """Store a bundle and request its activation, and return the name of the request."""
        values = {"name": bundle.name, "sum": self.put(bundle, kind), "hours": hours, "despite_faults": False}
        return self.request("activate", kind, **values | changes)

    def contact(self, frames: int, session: str = "a", limit_s: float = 0.0, fault: str = "") -> None:
        """Write the link's record of its last contact."""
        values = {"session": session, "frames": str(frames), "limit_s": limit_s, "fault": fault}
        (self.link / "renewal/contact").write_bytes(encoded(values))

    def changed(self, name: str) -> Path:
        """Return the present configuration under a new name."""
        path = self.place / f"{name}.yaml"
        lines = self.config.read_text(encoding="utf-8").splitlines(keepends=True)
        text = "".join(f"name: {name}\n" if line.startswith("name:") else line for line in lines)
        path.write_text(text, encoding="utf-8")
        return path

    def flown(self) -> str:
        """Return the name in the installed configuration, and check the checksum of this configuration."""
        data = self.config.read_bytes()
        accepted = self.config.with_name("flight.yaml.sha256").read_text(encoding="ascii").split()[0]
        assert accepted == hashlib.sha256(data).hexdigest()
        return next(line[6:] for line in data.decode().splitlines() if line.startswith("name: "))

    def restarted(self) -> bool:
        """Return whether flight and link must be restarted, and mark both as restarted."""
        path = self.own / "restart"
        found = path.exists()
        path.unlink(missing_ok=True)
        return found

    def release(self) -> str:
        """Return the label of the release that would start now."""
        return self.files.fly()[0]

    def reports(self, request: str) -> list[tuple[str, str]]:
        """Return the result and text of each report about a request."""
        status = decoded((self.own / "status").read_bytes())
        return [(result, text) for _, name, result, _, text in status["reports"] if name == request]

    def source(self, label: str) -> Path:
        """Return the folder of a release's sources with the given label."""
        builder = self.place / "bin/python3"
        builder.write_text(f'#!/bin/sh\nexec {self.files.python(label)} "$@"\n', encoding="utf-8")
        builder.chmod(0o755)
        folder = self.place / f"source-{label}"
        for part in ("deploy", "config", "knightcube/README.md", "pyproject.toml"):
            target = folder / part
            target.parent.mkdir(parents=True, exist_ok=True)
            if (ROOT / part).is_dir():
                shutil.copytree(
                    ROOT / part, target, symlinks=False, ignore=shutil.ignore_patterns("__pycache__")
                )
            else:
                shutil.copyfile(ROOT / part, target)
        (folder / "flight").mkdir()
        (folder / "flight/label").write_text(label, encoding="ascii")
        return folder
