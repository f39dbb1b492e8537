"""Flies the seven flights in a checkout of any revision, each by `python -m flight run` in its own process.

The flights of a revision are kept in a cache, because they depend only on the revision, the machine and the
interpreter with its libraries.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
import tarfile
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

TABLE_FILE = "packets.json"
_FLIGHT_LIMIT = 3600.0  # s of the machine's time for one flight
_DUMP_TABLE = """
import dataclasses, importlib, json, os, sys
# A project installed as editable serves the modules that this checkout does not have.
sys.meta_path = [finder for finder in sys.meta_path if "editable" not in str(finder).lower()]
for name in ("flight.link.telemetry.definitions", "flight.telemetry.definitions"):
    try:
        table = importlib.import_module(name)
        break
    except ModuleNotFoundError:
        continue
else:
    sys.exit("no packet definitions found")
if not table.__file__.startswith(os.getcwd()):
    sys.exit(f"{table.__file__} is not of this checkout")
table = table.PACKETS
json.dump([dataclasses.asdict(packet) for packet in table], sys.stdout)
"""


class FlightError(Exception):
    """A flight that could not be flown, or a revision that cannot be checked out."""


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight: its configuration, its duration (s; the configuration's when None) and its faults."""

    name: str
    config: str
    duration: float | None = None
    faults: tuple[str, ...] = ()

    @property
    def arguments(self) -> list[str]:
        """The arguments of `python -m flight run`, without the folder."""
        duration = [] if self.duration is None else ["--duration", f"{self.duration:g}"]
        return [self.config, *duration, *(word for fault in self.faults for word in ("--fault", fault))]


_DEMO, _THESIS = "config/step_demo.yaml", "config/step_thesis.yaml"

FLIGHTS: tuple[Flight, ...] = (
    Flight("demo", _DEMO),
    Flight("thesis", _THESIS),
    Flight("imu", _DEMO, 60, ("imu: silent @ 20 for 5", "imu: bits @ 32 for 5", "imu: silent @ 46 for 8")),
    Flight("coils", _DEMO, 60, ("coil-x: open @ 12 for 20", "coil-z: shorted @ 40", "bridge-y: a-low @ 50")),
    Flight(
        "camera",
        _DEMO,
        60,
        (
            "camera: torn @ 9 for 5",
            "vision: nan @ 19 for 5",
            "camera: black @ 29 for 5",
            "vision: exception @ 39 for 5",
            "vision: slow @ 49 for 6",
        ),
    ),
    Flight(
        "planner",
        _THESIS,
        60,
        ("planner: exception @ 4 for 4", "planner: nan @ 14 for 4", "planner: slow @ 29 for 20"),
    ),
    Flight(
        "bus",
        _DEMO,
        60,
        ("bus: nack @ 12 for 4", "pwm: brown-out @ 25", "monitor: bits @ 30 for 10", "bus: hang @ 48 for 3"),
    ),
)
SHORT = Flight("short", _DEMO, 8)  # for tests


def repository() -> Path:
    """Return the root of this checkout."""
    return Path(__file__).resolve().parents[3]


def resolve(revision: str) -> str:
    """Return the full hash of a commit. Raises FlightError when git does not know the revision."""
    return _git("rev-parse", "--verify", f"{revision}^{{commit}}").strip()


def check_out(commit: str, folder: Path) -> None:
    """Write the files of a commit into an empty folder."""
    archive = folder.with_suffix(".tar")
    _git("archive", "--format=tar", f"--output={archive}", commit)
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    archive.unlink()


def fly(checkout: Path, flight: Flight, out: Path) -> None:
    """Fly in `checkout` and leave the logs and the revision's packet table in `out`.

    Raises FlightError when the flight does not end well; `out` then does not exist.
    """
    work = out.with_name(out.name + ".part")
    shutil.rmtree(work, ignore_errors=True)
    work.parent.mkdir(parents=True, exist_ok=True)
    try:
        _python(checkout, "-m", "flight", "run", *flight.arguments, "--out", str(work), "--json")
        (work / TABLE_FILE).write_text(packet_table(checkout), encoding="utf-8")
    except FlightError as error:
        shutil.rmtree(work, ignore_errors=True)
        raise FlightError(f"{flight.name} in {checkout}: {error}") from error
    shutil.rmtree(out, ignore_errors=True)
    work.rename(out)


def packet_table(checkout: Path) -> str:
    """Return a checkout's packet definitions as JSON. Raises FlightError when it has none."""
    return _python(checkout, "-c", _DUMP_TABLE)


def cache_folder(root: Path, commit: str, flight: Flight) -> Path:
    """Return where a commit's flight is kept: commit, flight, and a hash of all else it depends on."""
    key = json.dumps([_DUMP_TABLE, flight.arguments, _machine(), sys.version, _libraries()])
    return root / commit[:12] / f"{flight.name}-{hashlib.sha256(key.encode()).hexdigest()[:12]}"


def _machine() -> str:
    """Return the processor's name: linear algebra libraries choose their code by it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return " ".join([platform.machine(), *models[:1]])


def _libraries() -> list[str]:
    names = ("numpy", "scipy", "nlopt", "msgspec", "spacepackets", "pyerfa", "pyyaml")
    found = []
    for name in names:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    return found


def _python(checkout: Path, *arguments: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    try:
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=checkout,
            env=environment,
            capture_output=True,
            text=True,
            timeout=_FLIGHT_LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise FlightError(f"not done after {_FLIGHT_LIMIT:g} s") from error
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no message"]
        raise FlightError(f"exit status {done.returncode}: {lines[-1]}")
    return done.stdout


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=repository(), capture_output=True, text=True, check=False)
    if done.returncode:
        raise FlightError(f"git {arguments[0]}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}")
    return done.stdout
