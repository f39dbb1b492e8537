"""The scripts of deploy/, called as a user calls them, and the configurations for these scripts."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from typing import Any

from flight.schema.reader import load
from tests.support.flights import CONFIG

ROOT = CONFIG.parents[1]
DEPLOY = ROOT / "deploy"
TESTBED = ROOT / "config" / "testbed.yaml"


def script(name: str) -> Any:
    """Import a Python script of deploy/, which is not a package, and return its module."""
    spec = importlib.util.spec_from_file_location(name, DEPLOY / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules.setdefault(name, module)  # `dataclass` looks up the module of a class here
    spec.loader.exec_module(module)
    return module


board_dropin = script("board_dropin")


def dropin(config: Path) -> str:
    """Return the systemd drop-in that the service needs for a configuration."""
    return str(board_dropin.dropin(load(config)))


def safe_dropin(config: Path) -> str:
    """Return the systemd drop-in of the safe-state unit."""
    return str(board_dropin.safe_dropin(load(config)))


def link_dropin(config: Path, root: Path = Path("/")) -> str:
    """Return the systemd drop-in of the link's unit.

    The folder `root` contains the board's /proc and /sys.
    """
    return str(board_dropin.link_dropin(load(config), root))


def changed_testbed(folder: Path, **sections: str) -> Path:
    """Return a copy of the testbed's configuration with changed sections or coil bus."""
    text = TESTBED.read_text(encoding="utf-8")
    for name, section in sections.items():
        if name == "coils_bus":
            text = re.sub(r"^  bus: \S+", f"  bus: {section}", text, flags=re.MULTILINE)
        else:
            text = re.sub(rf"^{name}: .*$", "", text, flags=re.MULTILINE) + f"\n{name}: {section}\n"
    path = folder / "flight.yaml"
    path.write_text(text, encoding="utf-8")
    return path
