"""Command `knightcube campaign`: many flights of a configuration with randomly drawn values."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from flight.app.cli import PROGRAM, to_json
from flight.app.cli.run import seed_number
from flight.schema.document import config_path
from ground.commands.options import CONFIG_HELP, count, interruptible, positive
from knightcube.errors import UsageError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube campaign` to the parser."""
    parser.description = (
        "Fly a simulated configuration many times, each time with values that are drawn from stated "
        "distributions, and with its own noise. Prints a table of the figures that the report judges, "
        "each with the varied value that influences it most, and lists failed flights with the command that "
        "repeats each. Plots the figures against the drawn values (extra `plots`). The flights run on all "
        "cores, or on a Dask cluster (extra `dask`). After an interruption, run the same command again to "
        "continue. Exit status 0 if every flight is within its limits, otherwise 1."
    )
    parser.epilog = (
        f"example: {PROGRAM} campaign orbit_3u --vary craft.inertia=10% --vary detumble.act=0.5..2 --runs 50"
    )
    add = parser.add_argument
    add("config", type=config_path, metavar="CONFIG", help=CONFIG_HELP)
    text = (
        "random value, may be repeated: 10%% (uniform, relative), +-0.5 (uniform), 'normal 10%%' or "
        "'normal 0.5' (standard deviation), 1..5 (uniform), 'log 1..100' (uniform in the logarithm), 'a|b|c' "
        "(one of these). Each number of a list is drawn on its own"
    )
    add("--vary", action="append", default=[], required=True, metavar="KEY=SPREAD", help=text)
    add("--runs", type=count, default=100, metavar="N", help="number of flights (default 100)")
    add("--seed", type=seed_number, default=1, metavar="N", help="seed of all draws (default 1)")
    add("--duration", type=positive, metavar="S", help="duration of each flight")
    add("--only", default="", metavar="TEXT", help="run only flights with this text in their name")
    add("--out", type=Path, metavar="DIR", help="folder (default runs/campaigns/NAME)")
    add("--workers", type=count, metavar="N", help="processes (default: number of cores)")
    add("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster, instead of this machine")
    add("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Run the campaign, and print its summary."""
    from ground.campaigns import CampaignError  # noqa: PLC0415
    from ground.campaigns.runner import fly, results_in  # noqa: PLC0415 - no other command needs devices
    from ground.campaigns.varied import (  # noqa: PLC0415
        draw_campaign,
        variation_of,
        varied_campaign,
    )

    campaign = varied_campaign(
        options.config, [variation_of(text) for text in options.vary], options.duration
    )
    out = options.out or Path("runs") / "campaigns" / options.config.stem
    try:
        where = {"workers": options.workers, "dask": options.dask, "only": options.only}
        with interruptible():
            found = fly(campaign, options.runs, options.seed, out, progress=True, **where)
    except KeyboardInterrupt:
        kept = len(results_in(out))
        text = f"interrupted; {kept} results are kept; run the same command again to continue in {out}"
        sys.stderr.write(f"\n{text}\n")
        return 130
    except CampaignError as error:
        raise CampaignError(f"{error}; run the same command again to continue in {out}") from error
    sys.stdout.write(to_json(found.facts) if options.json else found.text)
    try:
        drawn = draw_campaign(results_in(out), out / "campaign.png")
    except UsageError as error:
        sys.stderr.write(f"{PROGRAM}: not drawn: {error}\n")
    else:
        if drawn and not options.json:
            sys.stdout.write(f"\npicture: {out / 'campaign.png'}\n")
    return 0 if found.facts["within all limits"] == found.facts["flights"] else 1
