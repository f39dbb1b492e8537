"""Which lines of `flight/` the flights reach, measured by coverage.py in every process.

The flights: the step demonstration's first 110 s in lock-step (two targets); the first 30 s as
the thesis flies it; 12 s of the demonstration in real time with workers, guardian and devices in processes of
their own; the same with a ground that commands it over its socket; the five fault flights of
`tests.studies.same_bytes` and two more (a bridge's leg stuck high; a clock, a monitor and a disk that fail);
three runs into one archive, as the service flies them, with a kept state and a time line of commands, the
last of them after a power cut that damaged the log and the configuration; and starts that a wrong
configuration prevents. A line is a statement as coverage.py counts them; those of the ground's own processes
do not count.
"""

from __future__ import annotations

import hashlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.studies.same_bytes.flights import FLIGHTS, Flight

_DEMO = "config/step_demo.yaml"
FLOWN: tuple[tuple[Flight, tuple[str, ...]], ...] = (
    (Flight("demo", _DEMO, 110), ()),
    (Flight("thesis", "config/step_thesis.yaml", 30), ()),
    (Flight("realtime", _DEMO, 12), ("--realtime",)),
    (Flight("orbit", "config/orbit.yaml", 320), ()),
    *((flight, ()) for flight in FLIGHTS if flight.faults and not flight.changes),
    (Flight("bridge", _DEMO, 60, ("bridge-x: a-high @ 12 for 20", "pwm: stuck @ 45 for 3")), ()),
    (
        Flight(
            "board", _DEMO, 40, ("clock: stepped @ 10", "monitor: stuck @ 14 for 6", "disk: full @ 30 for 5")
        ),
        (),
    ),
)
_ORDERS = (
    "ping",
    "mode hold",
    "slew 0.05",
    "mode detumble",
    "clear coil-broken",
    "safe",
    "clear safe",
)
_SERVICE = """
state: {folder: FOLDER}
commands:
  timeline:
    - {at: 4, mode: hold}
    - {at: 8, slew: 0.1}
    - {at: 20, mode: detumble}
    - {at: 26, mode: safe}
    - {at: 28, clear: safe}
"""
_WRONG = (
    ("inertia: 1.05e-3", "inertia: heavy"),
    ("inertia: 1.05e-3", "inertai: 1.05e-3"),
    ("inertia: 1.05e-3", "inertia: -1.0"),
    ("rate_noise: 1.75e-4", "rate_noise: 1.75e-4, rate_noise: 1.0"),
    ("camera:", "camera: [1, 2]\nlens:"),
    ("stiffness: 1.0e-5", "stiffness: .nan"),
)
_SETTINGS = """
[run]
source = {root}/flight
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
if "flight.loop.worker" in sys.orig_argv:
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
        flights = _Flights(root, Path(temporary))
        for flight, more in FLOWN:
            flights.fly(flight, *more)
        flights.fly_commanded()
        flights.fly_as_service()
        flights.refuse()
        flights.check()
        found = list(_analyse(root, flights.settings))
    return sorted(found, key=lambda file: (file.reached - file.lines, file.file))


class _Flights:
    """Flies in processes whose lines are counted, each flight into a folder of its own."""

    def __init__(self, root: Path, folder: Path) -> None:
        self._root, self._folder = root, folder
        self._demonstration = (root / _DEMO).read_text(encoding="utf-8")
        self._state = folder / "state"
        self._state.mkdir()
        self.settings = folder / "coverage.ini"
        self.settings.write_text(_SETTINGS.format(root=root, folder=folder), encoding="utf-8")
        (folder / "sitecustomize.py").write_text(_SAVE_OFTEN, encoding="utf-8")

    def fly(self, flight: Flight, *more: str) -> None:
        """Fly to the end. Raises CalledProcessError."""
        out = () if "--archive" in more else ("--out", str(self._folder / flight.name))
        done = self._start(flight, *more, *out)
        if done.wait() != 0:
            raise subprocess.CalledProcessError(done.returncode, flight.name)
        sys.stderr.write(f"house: {flight.name} flown\n")

    def fly_commanded(self) -> None:
        """Fly in real time and send commands, one of them damaged."""
        path = self._folder / "orders"
        config = self._config("commanded", f"commands: {{socket: {path}}}\n")
        flying = self._start(Flight("commanded", str(config), 14), "--realtime", "--out", f"{path}.run")
        while not path.exists() and flying.poll() is None:
            time.sleep(0.1)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as noise:
            noise.connect(str(path))
            for data in (b"", b"\x18\x01", bytes(40)):
                noise.send(data)
        for words in _ORDERS:
            command = [sys.executable, "-m", "flight", "command", "--to", str(path), *words.split()]
            subprocess.run(command, cwd=self._root, check=False, stdout=subprocess.DEVNULL)
        if flying.wait() != 0:
            raise subprocess.CalledProcessError(flying.returncode, "commanded")
        sys.stderr.write("house: commanded flown\n")

    def fly_as_service(self) -> None:
        """Fly three times into one archive; a power cut damages log and configuration before the third."""
        archive = self._folder / "archive"
        config = self._config("service", _SERVICE.replace("FOLDER", str(self._state)))
        accepted = hashlib.sha256(config.read_bytes()).hexdigest()
        config.with_name(f"{config.name}.sha256").write_text(f"{accepted}  {config.name}\n", encoding="utf-8")
        for flown in range(3):
            if flown == 2:  # the third
                config.write_bytes(config.read_bytes().replace(b"1.05e-3", b"1.05e-7"))
                log = max(archive.rglob("*.ccsds"))
                os.truncate(log, log.stat().st_size - 100)
            self.fly(Flight("service", str(config), 30), "--archive", str(archive))

    def refuse(self) -> None:
        """Start with configurations that cannot be flown."""
        for k, (right, wrong) in enumerate(_WRONG):
            config = self._folder / f"wrong-{k}.yaml"
            config.write_text(self._demonstration.replace(right, wrong, 1), encoding="utf-8")
            refused = self._start(Flight("refused", str(config), 1), "--out", str(config.with_suffix("")))
            if refused.wait() == 0:
                raise subprocess.CalledProcessError(0, f"{right!r} -> {wrong!r} was flown")

    def check(self) -> None:
        """Run the check before a flight, of simulated devices and of devices that are missing."""
        for words in ((_DEMO,), (_DEMO, "--json"), ("config/testbed.yaml",)):
            self._run("check", *words).wait()

    def _config(self, name: str, more: str) -> Path:
        path = self._folder / f"{name}.yaml"
        path.write_text(self._demonstration + more, encoding="utf-8")
        return path

    def _start(self, flight: Flight, *more: str) -> subprocess.Popen[bytes]:
        return self._run("run", flight.config, *flight.options, *more)

    def _run(self, *arguments: str) -> subprocess.Popen[bytes]:
        words = ["-m", "coverage", "run", f"--rcfile={self.settings}", "-m", "flight"]
        places = f"{self._folder}{os.pathsep}{self._root}"
        return subprocess.Popen(
            [sys.executable, *words, *arguments],
            cwd=self._root,
            env={**os.environ, "PYTHONPATH": places, "STATE_DIRECTORY": str(self._state)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )


def _analyse(root: Path, settings: Path) -> Iterator[FileReach]:
    from coverage import Coverage  # noqa: PLC0415  # only this measurement needs the extra `bench`

    coverage = Coverage(config_file=str(settings))
    coverage.combine()
    coverage.load()
    for path in sorted((root / "flight").rglob("*.py")):
        _, statements, _, missing, _ = coverage.analysis2(str(path))
        if statements:
            yield FileReach(str(path.relative_to(root)), len(statements), len(statements) - len(missing))
