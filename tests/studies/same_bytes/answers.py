"""Records the results of a checkout's commands: star tracker, streaks, horizon, planners, identification.

The results are those of `python -m flight` commands, which any revision has even if modules move. Both
revisions process the same pictures: those that the old one rendered, and photographs if there are any.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.studies.same_bytes.checkout import repository, run_script

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


@dataclass(frozen=True, slots=True)
class Answers:
    """A group of commands that one process runs, each a line as in a shell, without `python -m flight`."""

    name: str
    commands: tuple[str, ...]

    @property
    def key(self) -> object:
        """List of all values on which the results depend, apart from revision and machine."""
        return [_ASK, self.commands]


_NIGHTS = tuple(f"pictures/night-{number}.png" for number in (1, 2, 3, 4))
_STARS = "solve pictures/stars.png --fov 15"
_STREAKS = "rate pictures/streaks.png --fov 15 --exposure 0.4"
_LIMB = "horizon pictures/limb.png --fov 67"
_SLEW = "plan --at 2026-03-01T12:00:00 --orbit"

# This group renders the pictures of the other groups; the pictures' bytes are compared too.
PICTURES = Answers(
    "pictures",
    (
        "samples --out .",
        "camera --config step_demo --out still.png",
        "camera --config step_demo --exposure 0.3 --rate 0.05 -0.02 0.01 --out turn.png",
    ),
)
GROUPS: tuple[Answers, ...] = (
    PICTURES,
    # Star tracker: lost in space by each method of identification, attitude, centroids; index; lens
    # calibration.
    Answers(
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
    Answers(
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
    Answers(  # horizon: nadir with and without the altitude, by each method; a picture without a limb
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
    Answers(
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
    Answers(
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
    Answers("identify", ("identify step_demo --duration 60 --run identified",)),
)


def photographs(folder: Path = PHOTOGRAPHS) -> Answers | None:
    """Return the commands for the real pictures of sky and limb in a folder, or None if it has none."""
    commands = [f"solve photographs/{name}" for name in _pictures(folder, "sky")]
    commands += [
        f"horizon photographs/{name} --fov 12.8 --altitude 515" for name in _pictures(folder, "limb")
    ]
    return Answers("photographs", tuple(commands)) if commands else None


def _pictures(folder: Path, part: str) -> Iterable[str]:
    """Return the names of the pictures in a subfolder."""
    paths = sorted((folder / part).glob("*"))
    return [f"{part}/{path.name}" for path in paths if path.suffix in {".jpg", ".png", ".tiff"}]


def ask(checkout: Path, answers: Answers, folder: Path) -> None:
    """Run a checkout's commands in `folder`; store results there, with digests of the written PNG files.

    Raises CheckoutError if a command raises.
    """
    commands = [json.dumps(shlex.split(command)) for command in answers.commands]
    raw = json.loads(run_script(checkout, _ASK, str(checkout), *commands, folder=folder))
    found: dict[str, object] = {}
    for line, command in zip(answers.commands, commands, strict=True):
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
