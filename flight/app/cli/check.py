"""`flight check`: whether a configuration would fly, here and now."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from flight.app.cli.run import counts_text, summary_facts
from flight.app.request import RunRequest, RunResult
from flight.schema import reader as configuration
from flight.schema.carried import config_path, names
from flight.schema.sections import Config

FLOWN_S = 10.0


@dataclass(slots=True)
class CheckResult:
    """The result of a check; an empty list of `problems` means ready to fly."""

    config: Config
    path: Path
    problems: list[str] = field(default_factory=list)
    devices: list[Any] = field(default_factory=list)
    result: RunResult | None = None
    elapsed: float = 0.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Check a configuration before it is flown. Its values are validated. Where it names real devices, "
        "each is looked for and asked for a sign of life; nothing is set up and no coil is driven. One that "
        "is missing is named with the cure. Where it has a simulation, ten seconds of it are flown in "
        "lock-step. Exit status 0: ready; 1: not ready; 2: the configuration is refused."
    )
    carried = ", ".join(names())
    parser.add_argument("config", type=config_path, metavar="CONFIG", help=f"YAML file, or one of {carried}")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=check)


def check(options: argparse.Namespace) -> int:
    """Examine, print the verdict; 1 when the configuration is not ready to fly."""
    from flight.app.accepted_config import accepted_config  # noqa: PLC0415
    from flight.app.composition import body_kind  # noqa: PLC0415 - the whole flight hangs on these
    from flight.app.devices import check_settings  # noqa: PLC0415
    from flight.app.flight import placing  # noqa: PLC0415
    from flight.app.probing import probe  # noqa: PLC0415

    chosen = accepted_config(options.config, os.environ)
    path = chosen.path
    config = configuration.parse(chosen.text, str(path))
    verdict = CheckResult(config, path, [chosen.problem] if chosen.problem else [])
    with placing(chosen.text, str(path)):
        body_kind(config)
        check_settings(config)
        if config.simulation is None:
            verdict.devices = probe(config)
            verdict.problems += [f"{item.name}: missing" for item in verdict.devices if not item.found]
        else:
            _fly(verdict)
    sys.stdout.write(json.dumps(_facts(verdict)) + "\n" if options.json else _text(verdict))
    return 1 if verdict.problems else 0


def _fly(verdict: CheckResult) -> None:
    """Fly the beginning in lock-step, into a folder that is forgotten."""
    from flight.app.flight import fly  # noqa: PLC0415

    duration, begun = min(FLOWN_S, verdict.config.duration), time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="knightcube-check-") as folder:
        verdict.result = fly(RunRequest(verdict.path, Path(folder) / "run", duration=duration))
    verdict.elapsed = time.perf_counter() - begun
    verdict.problems += flight_problems(verdict.result)


def flight_problems(result: RunResult) -> list[str]:
    """Return what went wrong in a flight; faults that were injected may be noticed and may leave alarms."""
    ending = result.ending
    problems = [text for text in (result.log_error, result.restart, ending.coil_error) if text]
    if result.interrupted:
        problems.append(f"the flight was {result.reason}")
    if not ending.coils_at_zero and not ending.coil_error:
        problems.append("the coils were not left at zero")
    if not result.faults:
        problems += [f"alarm: {name}" for name in ending.alarms]
        problems += [f"fault noticed: {name} ({count})" for name, count in sorted(ending.faults.items())]
    return problems


def _facts(verdict: CheckResult) -> dict[str, Any]:
    config, result = verdict.config, verdict.result
    flown = None if result is None else summary_facts(result, verdict.elapsed)
    return {
        "config": str(verdict.path),
        "name": config.name,
        "body": config.body,
        "simulated": config.simulation is not None,
        "devices": [asdict(item) for item in verdict.devices],
        "flight": flown,
        "problems": verdict.problems,
        "ready": not verdict.problems,
    }


def _text(verdict: CheckResult) -> str:
    config, result = verdict.config, verdict.result
    lines = [
        ("configuration", f"{verdict.path}: {config.name}, valid"),
        ("to fly", f"body {config.body}, {config.duration:g} s"),
        ("devices", "simulated" if config.simulation is not None else f"{len(verdict.devices)} looked for"),
    ]
    lines += [
        ("", f"{'found' if item.found else 'MISSING':8} {item.name}, {item.place}: {item.text}")
        for item in verdict.devices
    ]
    if result is not None:
        ending = result.ending
        noticed = f"{counts_text(ending.faults, 'faults')}; {counts_text(ending.warnings, 'warnings')}"
        lines.append(("flown", f"{ending.mission_time:.0f} s in lock-step; mode {ending.mode}"))
        lines.append(("noticed", noticed))
        if result.faults:
            lines.append(("injected", "; ".join(result.faults)))
    lines += [("problem", problem) for problem in verdict.problems]
    lines.append(("verdict", "not ready" if verdict.problems else "ready"))
    return "".join(f"{name + ':' if name else '':15}{text}\n" for name, text in lines)
