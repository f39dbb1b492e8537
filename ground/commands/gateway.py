"""`flight gateway`: plain packets on loopback for another's ground station, protected frames beyond."""

from __future__ import annotations

import argparse
import sys

from flight.app.ending_signals import EndingSignals
from ground.link.gateway import ADDRESS, Gateway
from ground.link.options import add_link_options, terminal_of


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Stand between a satellite's link and a ground station that holds no keys, such as Yamcs: whoever "
        "connects to the address gets every telemetry packet and may send command packets, which go up in "
        "protected frames. Loopback only. Ctrl-C ends."
    )
    add_link_options(parser, parser.add_mutually_exclusive_group(required=True))
    parser.add_argument(
        "--serve", default=ADDRESS, metavar="HOST:PORT", help=f"for ground stations (default {ADDRESS})"
    )
    parser.set_defaults(command=gateway)


def gateway(options: argparse.Namespace) -> int:
    """Carry packets until a signal."""
    terminal = terminal_of(options)
    try:
        carrier = Gateway(
            terminal, options.serve, lambda text: sys.stderr.write(f"flight: gateway: {text}\n")
        )
        try:
            sys.stdout.write(f"packets on 127.0.0.1:{carrier.port} (Ctrl-C ends)\n")
            sys.stdout.flush()
            with EndingSignals() as signals:
                carrier.run(lambda: signals.received)
        finally:
            carrier.close()
    finally:
        terminal.close()
    return 0
