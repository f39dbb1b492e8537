"""A board with a radio link: its keys, and a configuration with the addresses of the link."""

from __future__ import annotations

import json
import socket
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ground.link.terminal import make_keys
from tests.support.flights import CONFIG

ROOT = Path(__file__).resolve().parents[2]


def free_ports(kinds: list[socket.SocketKind]) -> list[int]:
    """Return a free port of loopback for each socket type."""
    with ExitStack() as stack:
        lines = [stack.enter_context(socket.socket(socket.AF_INET, kind)) for kind in kinds]
        for line in lines:
            line.bind(("127.0.0.1", 0))
        return [line.getsockname()[1] for line in lines]


def write_linked_config(place: Path, base: Path = CONFIG, **lines: Any) -> Path:
    """Create keys in `place`, and write a board's configuration with a link; return its path."""
    make_keys(place / "keys")
    section = {"keys": str(place / "keys" / "satellite"), **lines}
    commands = json.dumps({"socket": str(place / "commands")})
    config = place / "flight.yaml"
    text = base.read_text(encoding="utf-8")
    config.write_text(f"{text}\ncommands: {commands}\nlink: {json.dumps(section)}\n", encoding="utf-8")
    return config
