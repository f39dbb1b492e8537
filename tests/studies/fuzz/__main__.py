"""`python -m tests.studies.fuzz TARGET --inputs N --seed S`: feed mutated inputs; exit 1 on a find."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from collections.abc import Callable, Sequence

from tests.studies.fuzz.harness import Campaign, Target, run

TARGETS = {
    "vn100": "tests.studies.fuzz.vn100:Vn100Bytes",
    "config": "tests.studies.fuzz.configurations:Configurations",
    "commands": "tests.studies.fuzz.telecommands:Telecommands",
    "logs": "tests.studies.fuzz.logs:Logs",
    "link": "tests.studies.fuzz.link_frames:LinkFrames",
    "cli": "tests.studies.fuzz.arguments:Arguments",
    "state": "tests.studies.fuzz.stored_files:state",
    "schedule": "tests.studies.fuzz.stored_files:schedule",
    "keys": "tests.studies.fuzz.stored_files:keys",
    "releases": "tests.studies.fuzz.stored_files:releases",
    "flown": "tests.studies.fuzz.stored_files:flown",
    "elements": "tests.studies.fuzz.stored_files:elements",
    "index": "tests.studies.fuzz.tables:index",
    "stars": "tests.studies.fuzz.tables:stars",
    "images": "tests.studies.fuzz.tables:images",
    "gps": "tests.studies.fuzz.wires:gps",
    "i2c": "tests.studies.fuzz.wires:Parts",
    "uplink": "tests.studies.fuzz.wires:uplink",
    "downlink": "tests.studies.fuzz.wires:downlink",
    "files": "tests.studies.fuzz.units:Units",
    "workers": "tests.studies.fuzz.wires:workers",
}


def target_of(name: str) -> Target:
    """Return a new target."""
    module, _, kind = TARGETS[name].partition(":")
    made: Target = getattr(importlib.import_module(module), kind)()
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a campaign; return 0 when it found nothing."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.fuzz", description=__doc__)
    parser.add_argument("target", choices=sorted(TARGETS))
    parser.add_argument("--inputs", type=int, default=1000, metavar="N", help="how many (default 1000)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of the campaign (default 1)")
    parser.add_argument(
        "--first", type=int, default=0, metavar="I", help="begin with input I: to see one again"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    campaign = run(
        options.target,
        target_of(options.target),
        options.inputs,
        options.seed,
        first=options.first,
        progress=_progress(options.inputs),
    )
    if sys.stderr.isatty():
        sys.stderr.write("\r\x1b[K")
    facts = {
        "target": campaign.name,
        "seed": campaign.seed,
        "inputs": campaign.inputs,
        "cpu_s": round(campaign.cpu_s, 1),
        "slowest_s": round(campaign.slowest_s, 4),
        "tallies": dict(campaign.tallies),
        "found": dict(campaign.distinct),
        "findings": campaign.findings,
    }
    if options.json:
        sys.stdout.write(json.dumps(facts) + "\n")
    else:
        sys.stdout.write("".join(f"{key:10} {value}\n" for key, value in facts.items() if key != "findings"))
        for finding in campaign.findings:
            sys.stdout.write("\n" + "\n".join(f"{key}: {value}" for key, value in finding.items()) + "\n")
    return 0 if campaign.sound else 1


def _progress(inputs: int) -> Callable[[Campaign], None]:
    """Return what shows a line about once a second, on a terminal only."""
    if not sys.stderr.isatty():
        return lambda _: None
    last = time.monotonic()

    def show(campaign: Campaign) -> None:
        nonlocal last
        if time.monotonic() - last > 1.0:
            last = time.monotonic()
            found = sum(campaign.distinct.values())
            sys.stderr.write(f"\r\x1b[K{campaign.name} {campaign.inputs}/{inputs}  found {found}")
            sys.stderr.flush()

    return show


if __name__ == "__main__":
    raise SystemExit(main())
