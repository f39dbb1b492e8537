"""Which lines of `flight/` outside `gnc` the flights reach, measured by coverage.py in every process.

The flights: the step demonstration's first 110 s in lock-step (two targets); the first 30 s as
the thesis flies it; 12 s of the demonstration in real time with
workers, guardian and devices in processes of their own; two runs into one archive, as the service flies
them, with a kept state and a time line of commands; and the five fault flights of
`tests.studies.same_bytes`. A line is a statement as coverage.py counts them.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.studies.same_bytes.flights import FLIGHTS, Flight

FLOWN: tuple[tuple[Flight, tuple[str, ...]], ...] = (
    (Flight("demo", "config/step_demo.yaml", 110), ()),
    (Flight("thesis", "config/step_thesis.yaml", 30), ()),
    (Flight("realtime", "config/step_demo.yaml", 12), ("--realtime",)),
    *((flight, ()) for flight in FLIGHTS if flight.faults),
)
_SERVICE = """
state: {{folder: {folder}/state}}
commands:
  socket: {folder}/commands
  timeline:
    - {{at: 4, mode: hold}}
    - {{at: 8, slew: 0.1}}
    - {{at: 20, mode: detumble}}
    - {{at: 26, mode: safe}}
    - {{at: 28, clear: safe}}
"""
_SETTINGS = """
[run]
source = {root}/flight
omit = {root}/flight/gnc/*
data_file = {folder}/data
parallel = true
patch = subprocess, _exit
sigterm = true
disable_warnings = no-data-collected, module-not-imported, couldnt-parse
[report]
exclude_also =
    if TYPE_CHECKING:
    ^\\s*\\.\\.\\.$
"""
# Workers end by SIGKILL, when coverage.py can save nothing: they save every half second.
_SAVE_OFTEN = """
import sys, threading
if "flight.loop.executive.worker" in sys.orig_argv:
    from coverage import Coverage
    def save():
        while not threading.Event().wait(0.5):
            running = Coverage.current()
            if running is not None:
                running.save()
    threading.Thread(target=save, daemon=True).start()
"""


@dataclass(frozen=True, slots=True)
class FileReach:
    """A file's statements and how many of them a flight executed."""

    file: str
    lines: int
    reached: int

    def __str__(self) -> str:
        return f"{self.file:52} {self.lines - self.reached:5} of {self.lines:5}"


def measure(root: Path) -> list[FileReach]:
    """Fly and return every file, those with most unreached lines first. Raises CalledProcessError."""
    with tempfile.TemporaryDirectory(prefix="reached-") as temporary:
        folder = Path(temporary)
        settings = folder / "coverage.ini"
        settings.write_text(_SETTINGS.format(root=root, folder=folder), encoding="utf-8")
        (folder / "sitecustomize.py").write_text(_SAVE_OFTEN, encoding="utf-8")
        environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{root}"}
        service = folder / "service.yaml"
        demonstration = (root / "config/step_demo.yaml").read_text(encoding="utf-8")
        service.write_text(demonstration + _SERVICE.format(folder=folder), encoding="utf-8")
        flown = [(flight, [*more, "--out", str(folder / flight.name)]) for flight, more in FLOWN]
        archived = (Flight("service", str(service), 30), ["--archive", str(folder / "archive")])
        for flight, more in (*flown, archived, archived):
            command = ["-m", "coverage", "run", f"--rcfile={settings}", "-m", "flight", "run"]
            words = [*command, *flight.arguments, *more]
            subprocess.run(
                [sys.executable, *words], cwd=root, env=environment, check=True, stdout=subprocess.DEVNULL
            )
            sys.stderr.write(f"house: {flight.name} flown\n")
        found = list(_analyse(root, settings))
    return sorted(found, key=lambda file: (file.reached - file.lines, file.file))


def _analyse(root: Path, settings: Path) -> Iterator[FileReach]:
    from coverage import Coverage  # noqa: PLC0415  # only this measurement needs the extra `bench`

    coverage = Coverage(config_file=str(settings))
    coverage.combine()
    coverage.load()
    for path in sorted((root / "flight").rglob("*.py")):
        if (root / "flight" / "gnc") in path.parents:
            continue
        _, statements, _, missing, _ = coverage.analysis2(str(path))
        if statements:
            yield FileReach(str(path.relative_to(root)), len(statements), len(statements) - len(missing))
