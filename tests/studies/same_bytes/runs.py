"""The flights and commands whose results are compared, and their execution in a checkout of any revision.

All commands are commands of `python -m flight`, which exists in any revision even if modules move. Both
revisions process the same pictures: those rendered by the old revision, and photographs if there are any.
"""

from __future__ import annotations

import hashlib
import json
import shlex
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tests.studies.same_bytes.checkout import repository, run_python, run_script

ANSWERS_FILE = "answers.json"
PHOTOGRAPHS = repository().parent / "shared/data"
# One process runs all commands of a group, because imports and the sky index take longer than a command.
_ASK = """
import contextlib, io, json, os, runpy, sys
checkout, *commands = sys.argv[1:]
answers = {}
for command in commands:
    out, err, status = io.StringIO(), io.StringIO(), None
    sys.argv = ["flight", *json.loads(command), "--json"]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            runpy.run_module("flight", run_name="__main__")
        except SystemExit as end:
            status = end.code
    answers[command] = [status or 0, out.getvalue(), err.getvalue()]
package = list(sys.modules["flight"].__path__)[0]
if not package.startswith(checkout + os.sep):
    sys.exit(f"{package} is not of this checkout")
json.dump(answers, sys.stdout)
"""


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
class Run:
    """Commands that one process runs; each is a line as in a shell, without `python -m flight`.

    Attributes:
        flight: arguments of the command `run`, beginning with the configuration, or empty. This command runs
            first.
        changes: YAML that replaces values of the flight's configuration.
    """

    name: str
    commands: tuple[str, ...] = ("report . --no-figures",)
    flight: str = ""
    changes: str = ""

    @property
    def key(self) -> object:
        """List of all values on which the results depend, apart from revision and machine."""
        return [_ASK, _DUMP_TABLE, self.commands, self.flight, self.changes]

    @property
    def reads_pictures(self) -> bool:
        """Whether a command reads a picture of the group `PICTURES`."""
        return any("pictures/" in command for command in self.commands)


_DEMO, _THESIS = "config/step_demo.yaml", "config/step_thesis.yaml"


def _demo(name: str, *faults: str, config: str = _DEMO) -> Run:
    """Return a flight of a minute with faults."""
    words = [word for fault in faults for word in ("--fault", fault)]
    return Run(name, flight=shlex.join([config, "--duration", "60", *words]))


FLIGHTS: tuple[Run, ...] = (
    Run("demo", flight=_DEMO),
    Run("thesis", flight=_THESIS),
    _demo("imu", "imu: silent @ 20 for 5", "imu: bits @ 32 for 5", "imu: silent @ 46 for 8"),
    _demo("coils", "coil-x: open @ 12 for 20", "coil-z: shorted @ 40", "bridge-y: a-low @ 50"),
    _demo(
        "camera",
        *("camera: torn @ 9 for 5", "vision: nan @ 19 for 5", "camera: black @ 29 for 5"),
        *("vision: exception @ 39 for 5", "vision: slow @ 49 for 6"),
    ),
    _demo(
        "planner",
        *("planner: exception @ 4 for 4", "planner: nan @ 14 for 4", "planner: slow @ 29 for 20"),
        config=_THESIS,
    ),
    _demo(
        "bus",
        *("bus: nack @ 12 for 4", "pwm: brown-out @ 25", "monitor: bits @ 30 for 10", "bus: hang @ 48 for 3"),
    ),
    # The KnightCube starts at 0.6 deg/s. Its flight has streak rates, detumbling, attitude acquisition, slews
    # to Sun and nadir that avoid exclusion cones, star frames with the Earth, and horizon frames with Sun and
    # limb. GPS and a camera fail for a time.
    Run(
        "orbit",
        flight="config/orbit.yaml --duration 240"
        " --fault 'gps: silent @ 60 for 30' --fault 'wide: black (camera=1) @ 100 for 30'",
        changes="{targets: [{at: 0.0, point: sun}, {at: 120.0, point: nadir, roll_deg: 0.0}],"
        " simulation: {free_body: {release: {speed: 0.01}}}}",
    ),
    # A 3U flies as configured, with a tumble at 10 deg/s, streaks, rates from the magnetometer, Sun and limb.
    Run("orbit_3u", flight="config/orbit_3u.yaml --duration 60"),
    # An object passes among the stars, is detected and followed, and its orbit is determined.
    Run(
        "orbit_object", ("report . --no-figures", "orbit ."), flight="config/orbit_object.yaml --duration 90"
    ),
)
SHORT = Run("short", flight=f"{_DEMO} --duration 8")  # used only by tests

_NIGHTS = tuple(f"pictures/night-{number}.png" for number in (1, 2, 3, 4))
_STARS = "solve pictures/stars.png --fov 15"
_STREAKS = "rate pictures/streaks.png --fov 15 --exposure 0.4"
_LIMB = "horizon pictures/limb.png --fov 67"
_SLEW = "plan --at 2026-03-01T12:00:00 --orbit"

# This group renders the pictures of the other groups; the pictures' bytes are compared too.
PICTURES = Run(
    "pictures",
    (
        "samples --out .",
        "camera --config step_demo --out still.png",
        "camera --config step_demo --exposure 0.3 --rate 0.05 -0.02 0.01 --out turn.png",
    ),
)
GROUPS: tuple[Run, ...] = (
    PICTURES,
    # Star tracker: lost in space by each method of identification, attitude, centroids; index; lens
    # calibration.
    Run(
        "stars",
        (
            "solve pictures/stars.png",
            _STARS,
            "solve pictures/still.png --camera step_demo",
            *(f"solve {night} --date 2026-11-21" for night in _NIGHTS),
            *(
                f"{_STARS} --fov-error 0.2 --method {method}"
                for method in (
                    *("angle", "spherical-triangle", "planar-triangle", "pyramid", "rate", "voting", "grid"),
                )
            ),
            *(
                f"{_STARS} --attitude {solver}"
                for solver in ("davenport", "esoq2", "foam", "olae", "predictive", "quest", "svd", "triad")
            ),
            *(
                f"{_STARS} --centroid {centroid}"
                for centroid in ("window", "weighted", "gaussian", "iterative")
            ),
            "solve pictures/limb.png",
            "index --fov 15 --faintest 5.5 --out mission.index",
            f"{_STARS} --index mission.index --wcs stars.fits",
            f"calibrate {' '.join(_NIGHTS)} --fov 15",
        ),
    ),
    # Streaks: rates, with a satellite among the streaks; attitude from streaks; stars that do not move.
    Run(
        "streaks",
        (
            _STREAKS,
            f"{_STREAKS} --prior 0.035 -0.02 0.015 --line-time 3e-5",
            f"{_STREAKS} --prior 0.035 -0.02 0.015",
            "rate pictures/turn.png --camera step_demo --exposure 0.3 --prior 0.05 -0.02 0.01",
            "rate pictures/stars.png --fov 15 --exposure 0.4",
            *(
                f"{_STREAKS} --method {method}"
                for method in ("harris", "minimum-eigenvalue", "trajkovic-4", "trajkovic-8")
            ),
            "solve pictures/streaks.png --fov 15 --exposure 0.4 --prior 0.035 -0.02 0.015",
            "solve pictures/turn.png --camera step_demo --exposure 0.3",
        ),
    ),
    Run(  # horizon: nadir with and without the altitude, by each method; a picture without a limb
        "horizon",
        (
            f"{_LIMB} --altitude 515",
            _LIMB,
            f"{_LIMB} --altitude 515 --method circle",
            f"{_LIMB} --altitude 515 --method vector --second pictures/limb.png",
            f"{_LIMB} --altitude 515 --method graphic --second pictures/limb.png --turned 90",
            "horizon pictures/stars.png --fov 15 --altitude 515",
        ),
    ),
    # One-axis planner: a duration that is extended, non-zero rates at the ends, minimum supply energy, a cost
    # of time, the thesis's configuration, and an angle out of range.
    Run(
        "plan",
        (
            "plan --from 0.4 --to -0.3",
            "plan --from 0.4 --from-rate 0.015 --to -0.3 --to-rate -0.01 --horizon 30",
            "plan --from 0.1 --to 0.3 --cost supply --nodes 16",
            "plan --from 0.1 --to 0.3 --time-price 0.001",
            "plan --from -0.2 --to 0.2 --config step_thesis",
            "plan --from 2 --to 0",
        ),
    ),
    # Three-axis planner: minimum energy, exclusion cones, minimum time, best start, a time that is too short.
    Run(
        "slew",
        (
            f"{_SLEW} orbit --from nadir --to sun --within 600",
            f"{_SLEW} orbit --from nadir --to sun --within 600 --sun-cone 23 --earth-cone 9 --moon-cone 11",
            f"{_SLEW} orbit_3u --from 'nadir roll 0' --to 'ground 48 11' --within 600 --least-time",
            f"{_SLEW} orbit --from nadir --to velocity --within 300 --window 1000",
            f"{_SLEW} orbit --from nadir --to 'inertial 0 0 0 1' --within 20",
        ),
    ),
    # Identification of a body's constants from a simulated flight.
    Run("identify", ("identify step_demo --duration 60 --run identified",)),
)


def photographs(folder: Path = PHOTOGRAPHS) -> Run | None:
    """Return the commands for the real pictures of sky and limb in a folder, or None if it has none."""
    commands = [f"solve photographs/{name}" for name in _pictures(folder, "sky")]
    commands += [
        f"horizon photographs/{name} --fov 12.8 --altitude 515" for name in _pictures(folder, "limb")
    ]
    return Run("photographs", tuple(commands)) if commands else None


def _pictures(folder: Path, part: str) -> Iterable[str]:
    """Return the names of the pictures in a subfolder."""
    paths = sorted((folder / part).glob("*"))
    return [f"{part}/{path.name}" for path in paths if path.suffix in {".jpg", ".png", ".tiff"}]


def perform(checkout: Path, run: Run, folder: Path, pictures: Path) -> None:
    """Run flight and commands in a new folder; store logs, the revision's packet table and results there.

    Raises CheckoutError if the flight or a command fails.
    """
    if run.flight:
        _fly(checkout, run, folder)
        (folder / TABLE_FILE).write_text(packet_table(checkout), encoding="utf-8")
    else:
        folder.mkdir()
        (folder / "pictures").symlink_to(pictures)
        (folder / "photographs").symlink_to(PHOTOGRAPHS)
    ask(checkout, run, folder)


def _fly(checkout: Path, run: Run, folder: Path) -> None:
    path, *options = shlex.split(run.flight)
    config = checkout / path
    with tempfile.TemporaryDirectory(prefix="same-bytes-") as temporary:
        if run.changes:
            values = yaml.safe_load(config.read_text(encoding="utf-8"))
            config = Path(temporary) / config.name
            text = yaml.safe_dump(_merged(values, yaml.safe_load(run.changes)))
            config.write_text(text, encoding="utf-8")
        run_python(checkout, "-m", "flight", "run", str(config), *options, "--out", str(folder), "--json")


def ask(checkout: Path, run: Run, folder: Path) -> None:
    """Run a checkout's commands in `folder`; store results there, with digests of the written PNG files.

    Raises CheckoutError if a command raises.
    """
    commands = [json.dumps(shlex.split(command)) for command in run.commands]
    raw = json.loads(run_script(checkout, _ASK, str(checkout), *commands, folder=folder))
    found: dict[str, object] = {}
    for line, command in zip(run.commands, commands, strict=True):
        status, output, error = raw[command]
        found[line] = {"status": status, "output": _values(output), "error": error.splitlines()}
    for path in sorted(folder.glob("*.png")):
        found[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / ANSWERS_FILE).write_text(json.dumps(found), encoding="utf-8")


def _values(output: str) -> Any:
    """Return the values of a JSON text, or the lines of a text that is not JSON."""
    try:
        return json.loads(output)
    except ValueError:
        return output.splitlines()


def packet_table(checkout: Path) -> str:
    """Return a checkout's packet definitions as JSON. Raises CheckoutError if it has none."""
    return run_script(checkout, _DUMP_TABLE)


def _merged(values: Any, changes: Any) -> Any:
    """Return nested mappings in which values of `changes` replace those of `values`."""
    if not (isinstance(values, dict) and isinstance(changes, dict)):
        return changes
    return values | {name: _merged(values.get(name), change) for name, change in changes.items()}
