"""Flies the ten flights in a checkout of any revision, each by `python -m flight run` in its own process."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tests.studies.same_bytes.answers import Answers, ask
from tests.studies.same_bytes.checkout import run_python, run_script

TABLE_FILE = "packets.json"
_DUMP_TABLE = """
import dataclasses, importlib, json, os, sys
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


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight, and the commands that are run on its folder.

    Attributes:
        duration: duration (s), or None for that of the configuration.
        faults: arguments of `flight run --fault`.
        changes: YAML that replaces values of the configuration.
        questions: commands that run in the folder of the flight.
    """

    name: str
    config: str
    duration: float | None = None
    faults: tuple[str, ...] = ()
    changes: str = ""
    questions: tuple[str, ...] = ("report . --no-figures",)

    @property
    def options(self) -> list[str]:
        """Arguments of `python -m flight run` besides configuration and folder."""
        duration = [] if self.duration is None else ["--duration", f"{self.duration:g}"]
        return [*duration, *(word for fault in self.faults for word in ("--fault", fault))]

    @property
    def key(self) -> object:
        """List of all values on which the flight depends, apart from revision and machine."""
        return [_DUMP_TABLE, self.config, self.options, self.changes, Answers(self.name, self.questions).key]


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
    # The KnightCube starts at 0.6 deg/s. Its flight has streak rates, detumbling, attitude acquisition, slews
    # to Sun and nadir that avoid exclusion cones, the Earth in star frames, and Sun and limb in the horizon
    # cameras. GPS and a camera fail for a time.
    Flight(
        "orbit",
        "config/orbit.yaml",
        240,
        ("gps: silent @ 60 for 30", "wide: black (camera=1) @ 100 for 30"),
        "{targets: [{at: 0.0, point: sun}, {at: 120.0, point: nadir, roll_deg: 0.0}],"
        " simulation: {free_body: {release: {speed: 0.01}}}}",
    ),
    # A 3U flies as configured, with a tumble at 10 deg/s, streaks, rates from the magnetometer, Sun and limb.
    Flight("orbit_3u", "config/orbit_3u.yaml", 60),
    # An object passes among the stars, is detected and followed, and its orbit is determined.
    Flight("orbit_object", "config/orbit_object.yaml", 90, questions=("report . --no-figures", "orbit .")),
)
SHORT = Flight("short", _DEMO, 8)  # used only by tests


def fly(checkout: Path, flight: Flight, folder: Path) -> None:
    """Fly in `checkout`; store logs, the revision's packet table and command results in `folder`.

    Raises CheckoutError if the flight fails.
    """
    config = checkout / flight.config
    with tempfile.TemporaryDirectory(prefix="same-bytes-") as temporary:
        if flight.changes:
            values = yaml.safe_load(config.read_text(encoding="utf-8"))
            config = Path(temporary) / config.name
            text = yaml.safe_dump(_merged(values, yaml.safe_load(flight.changes)))
            config.write_text(text, encoding="utf-8")
        arguments = (str(config), *flight.options, "--out", str(folder), "--json")
        run_python(checkout, "-m", "flight", "run", *arguments)
    (folder / TABLE_FILE).write_text(packet_table(checkout), encoding="utf-8")
    ask(checkout, Answers(flight.name, flight.questions), folder)


def packet_table(checkout: Path) -> str:
    """Return a checkout's packet definitions as JSON. Raises CheckoutError if it has none."""
    return run_script(checkout, _DUMP_TABLE)


def _merged(values: Any, changes: Any) -> Any:
    """Return nested mappings in which values of `changes` replace those of `values`."""
    if not (isinstance(values, dict) and isinstance(changes, dict)):
        return changes
    return values | {name: _merged(values.get(name), change) for name, change in changes.items()}
