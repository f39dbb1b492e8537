"""Updates of a board over the link, under systemd; `tests.deploy.container` runs this module."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from tests.deploy.container import LINK
from tests.deploy.scenario import SERVICE, systemctl, wait
from tests.deploy.scripts import ROOT

LINK_SERVICE = "knightcube-link.service"
CONFIG, STATUS = Path("/etc/knightcube/flight.yaml"), Path("/var/lib/knightcube-renewal/status")
TRIAL = ("--timeout", "600", "--despite-faults")
"""Options of the command that activates an update. Reported faults do not end the trial of the update.

On a busy machine the emulated devices respond late, which a flight reports as a fault.
"""
FUTURE = "from __future__ import annotations\n"
FAULT = "import sys\nif '--archive' in sys.argv:\n    raise SystemExit('broken on purpose')\n"
"""Code of a faulty release. The self-test does not detect the fault, and each flight of the service ends at
once."""
VERSION = re.compile(r'(?m)^version = "(\d+\.\d+)\.(\d+)"')


class Ground:
    """The ground station: its keys, the address of the link, and the commands of the documentation."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._satellite = ["--link", LINK, "--keys", "keys/ground"]

    def run(self, *words: object) -> tuple[int, str]:
        """Run a command; return its exit status and its output."""
        done = subprocess.run(
            [sys.executable, "-m", "flight", *map(str, words)],
            cwd=self._folder,
            capture_output=True,
            text=True,
            check=False,
        )
        return done.returncode, done.stdout + done.stderr

    def call(self, command: str, *words: object) -> tuple[int, str]:
        """Run a command for the satellite. `command` contains the words that precede the link's options."""
        return self.run(*command.split(), *self._satellite, *words)

    def renew(self, kind: str, artefact: Path, version: int) -> dict[str, Any]:
        """Sign, uplink, activate and confirm an artefact; return exit statuses, outputs and the time (s)."""
        begun = time.monotonic()
        bundle = f"{kind}-{version}.renewal"
        steps = {
            "sign": self.run("renewal", "sign", "signing", kind, artefact, "--version", version),
            "put": self.call("files", "put", kind, bundle),
            "activate": self.call("renewal activate", kind, bundle, *TRIAL),
        }
        if steps["activate"][0] == 0:
            # A command that is sent while the link restarts for the trial is lost. An operator sends the
            # command again.
            for _ in range(6):
                steps["confirm"] = self.call("renewal confirm", kind, "--timeout", "30")
                if steps["confirm"][0] == 0:
                    break
        return {"steps": steps, "duration": time.monotonic() - begun, "flown": flown_release()}


def _are_up() -> bool:
    states = systemctl("show", "--value", "-p", "ActiveState", SERVICE, LINK_SERVICE).split()
    return states == ["active", "active"]


def flown_release() -> list[str]:
    """Return the names of the releases from which the flight and the link run."""
    names = []
    for unit in (SERVICE, LINK_SERVICE):
        pid = int(systemctl("show", "--value", "-p", "MainPID", unit))
        words = Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8") if pid else ""
        found = re.search(r"releases/([^/]+)/", words)
        names.append(found[1] if found else words)
    return names


def sources(folder: Path, step: int) -> Path:
    """Return a copy of the sources of this repository whose version is `step` higher."""
    folder.mkdir()
    parts = ("knightcube", "flight", "hal", "sim_hal", "ground", "deploy", "config")
    for part in parts:
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    for path in ROOT.iterdir():
        if path.is_file():
            shutil.copyfile(path, folder / path.name)
    settings = folder / "pyproject.toml"
    text = settings.read_text(encoding="utf-8")
    settings.write_text(
        VERSION.sub(lambda found: f'version = "{found[1]}.{int(found[2]) + step}"', text, count=1),
        encoding="utf-8",
    )
    return folder


def play(folder: Path, facts: Path) -> dict[str, Any]:
    """Update configuration and release of a board in flight, and return the observations."""
    systemctl("start", "knightcube-devices.service")
    wait(facts.exists, 20.0)
    systemctl("start", SERVICE, LINK_SERVICE, "knightcube-renewal.timer")
    wait(_are_up, 60.0)
    wait(STATUS.exists, 60.0)  # the link refuses updates before the first run of the privileged program
    ground = Ground(folder)
    seen: dict[str, Any] = {
        "first": flown_release(),
        "ping": ground.call("command", "ping"),
    }
    second = folder / "second.yaml"
    second.write_text(f"{CONFIG.read_text(encoding='utf-8')}# second\n", encoding="utf-8")
    seen["configuration"] = ground.renew("configuration", second, 2)
    seen["configuration"]["is_second"] = CONFIG.read_text(encoding="utf-8").endswith("# second\n")
    seen["release"] = ground.renew("release", sources(folder / "release", 1), 901)
    broken = sources(folder / "broken", 2)
    command = broken / "flight/app/cli/run.py"
    text = command.read_text(encoding="utf-8")
    assert FUTURE in text
    command.write_text(text.replace(FUTURE, FUTURE + FAULT, 1), encoding="utf-8")
    seen["broken"] = ground.renew("release", broken, 902)
    systemctl("stop", "knightcube-renewal.timer", SERVICE, LINK_SERVICE)
    return seen


if __name__ == "__main__":
    place = Path(sys.argv[1])
    observed = play(place, Path(sys.argv[2]))
    systemctl("stop", "knightcube-devices.service")
    (place / "seen.json").write_text(json.dumps(observed, indent=1), encoding="utf-8")
