"""`python -m tests.studies.campaigns`: runs a campaign by name. Only the requested campaign is imported."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from ground.campaigns import CampaignError
from ground.campaigns.runner import fly
from knightcube.errors import UsageError
from tests.studies.campaigns import CAMPAIGNS, campaign


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a campaign.

    Returns 0 if the campaign is complete, 1 if the cluster is lost, 2 for wrong use, 130 if interrupted.
    """
    listed = "\n".join(f"  {name:18} {one.purpose}" for name, one in CAMPAIGNS.items())
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.campaigns",
        description="Run a Monte Carlo campaign. After an interruption, the same command continues it.",
        epilog=f"campaigns:\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", choices=sorted(CAMPAIGNS), metavar="NAME", help="one of the list below")
    parser.add_argument("--runs", type=_positive, metavar="N", help="runs of each cell, or of all cells")
    parser.add_argument("--hours", type=_positive, dest="runs", metavar="H", help="for soak: hours of flight")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="seed of all draws (default 1)")
    parser.add_argument(
        "--only",
        default="",
        metavar="TEXT",
        help="only cases with TEXT in their key, such as 'coil-x: open'",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder (default runs/campaigns/NAME)")
    parser.add_argument("--workers", type=_positive, metavar="N", help="processes (default: number of cores)")
    parser.add_argument(
        "--dask", metavar="ADDRESS", help="scheduler of a Dask cluster, instead of this machine"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    options = parser.parse_args(arguments)
    chosen = campaign(options.name)
    out = options.out or Path("runs") / "campaigns" / chosen.name
    try:
        summary = fly(
            chosen,
            options.runs or chosen.default_runs,
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
        sys.stderr.write(f"campaigns: {error}; the same command continues the campaign in {out}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write(f"\ninterrupted; the same command continues the campaign in {out}\n")
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
