"""`python -m tests.studies.campaigns`: runs a campaign by name.

A campaign is a constant `Campaign("name", "purpose", ...)` of a module of this package. The list of campaigns
is read from the sources, and only the requested campaign is imported.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ground.campaigns import CampaignError
from ground.campaigns.runner import Campaign, fly
from knightcube.errors import UsageError


@dataclass(frozen=True, slots=True)
class Listed:
    """A campaign that is not imported yet."""

    module: str
    constant: str
    purpose: str

    def load(self) -> Campaign:
        """Import and return the campaign."""
        found = getattr(importlib.import_module(f"tests.studies.campaigns.{self.module}"), self.constant)
        assert isinstance(found, Campaign)
        return found


def campaigns() -> dict[str, Listed]:
    """Return every campaign by name, in the order of the modules."""
    found = {}
    for path in sorted(Path(__file__).parent.glob("*.py")):
        text = path.read_text(encoding="utf-8")
        for node in ast.parse(text).body if " = Campaign(\n" in text else ():
            match node:
                case ast.Assign(
                    targets=[ast.Name(id=constant)],
                    value=ast.Call(
                        func=ast.Name(id="Campaign"),
                        args=[ast.Constant(value=str(name)), ast.Constant(value=str(purpose)), *_],
                    ),
                ):
                    found[name] = Listed(path.stem, constant, purpose)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a campaign.

    Returns 0 if the campaign is complete, 1 if the cluster is lost, 2 for wrong use, 130 if interrupted.
    """
    known = campaigns()
    listed = "\n".join(f"  {name:18} {campaign.purpose}" for name, campaign in known.items())
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.campaigns",
        description="Run a Monte Carlo campaign on all cores. Broken off, it goes on where it was.",
        epilog=f"campaigns:\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", choices=sorted(known), metavar="NAME", help="which campaign")
    parser.add_argument("--runs", type=_positive, metavar="N", help="runs of each cell, or of the whole")
    parser.add_argument("--hours", type=_positive, dest="runs", metavar="H", help="of soak: hours of flight")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="seed of all draws (default 1)")
    parser.add_argument(
        "--only", default="", metavar="TEXT", help="only cases whose key contains it: 'coil-x: open', ' 3.0 '"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder (default runs/campaigns/NAME)")
    parser.add_argument("--workers", type=_positive, metavar="N", help="processes (default: the cores)")
    parser.add_argument(
        "--dask", metavar="ADDRESS", help="scheduler of a Dask cluster, instead of this machine"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    options = parser.parse_args(arguments)
    campaign = known[options.name].load()
    out = options.out or Path("runs") / "campaigns" / campaign.name
    try:
        summary = fly(
            campaign,
            options.runs or campaign.default_runs,
            options.seed,
            out,
            options.workers,
            options.dask,
            progress=True,
            only=options.only,
        )
    except UsageError as error:
        sys.stderr.write(f"campaigns: {error}\n")
        return 2
    except CampaignError as error:
        sys.stderr.write(f"campaigns: {error}; the same command goes on where it was ({out})\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write(f"\nbroken off; the same command goes on where it was ({out})\n")
        return 130
    if options.json:
        sys.stdout.write(json.dumps(summary.facts) + "\n")
    else:
        sys.stdout.write(summary.text)
    return 0


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not at least 1")
    return value


if __name__ == "__main__":
    raise SystemExit(main())
