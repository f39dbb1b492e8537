"""`flight gateway`: plain packets on loopback for another's ground station, protected frames beyond."""

from __future__ import annotations

import argparse
import sys

from flight.app.service import EndingSignals
from ground.link.command_stream import new_token
from ground.link.gateway import ADDRESS, Gateway
from ground.link.options import add_link_options, terminal_of
from ground.link.token_file import token_file, token_path


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Stand between a satellite's link and a ground station that holds no keys, such as Yamcs: a "
        "connection to the address gets every telemetry packet and may send command packets, which go up in "
        "protected frames. The first line of a connection must be a token, which is new at each start and "
        "lies in the file KEYS/gateway-PORT.token; a connection that sends anything else is closed. Loopback "
        "only. Ctrl-C ends."
    )
    add_link_options(parser, parser.add_mutually_exclusive_group(required=True))
    parser.add_argument(
        "--serve", default=ADDRESS, metavar="HOST:PORT", help=f"for ground stations (default {ADDRESS})"
    )
    parser.set_defaults(command=gateway)


def gateway(options: argparse.Namespace) -> int:
    """Carry packets until a signal."""
    terminal = terminal_of(options)
    token = new_token()
    try:
        carrier = Gateway(
            terminal, options.serve, token, lambda text: sys.stderr.write(f"flight: gateway: {text}\n")
        )
        path = token_path(options.keys, carrier.port)
        try:
            with EndingSignals() as signals, token_file(path, token):
                sys.stdout.write(f"packets on 127.0.0.1:{carrier.port}, token in {path} (Ctrl-C ends)\n")
                sys.stdout.flush()
                carrier.run(lambda: signals.received)
        finally:
            carrier.close()
    finally:
        terminal.close()
    return 0
