"""Updates of real releases over the link.

The releases are built from the sources of this repository with pip, virtual environments and the packages of
this Python environment. Only systemd and the radio are replaced by test doubles. `deploy/install.sh` installs
the first release into a folder. The second release has a higher version. The ground signs its bundle, sends
it by CFDP and activates it. The privileged program builds the release and is killed once during the build.
The release passes its self-test, is used on trial and is confirmed. Then the ground revokes it, and the board
uses the first release again. A third release passes its self-test, but its flight with the board's
configuration ends at once, so the board returns to the previous release.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from contextlib import closing
from importlib.metadata import distribution
from pathlib import Path

from flight import __version__
from flight.link.process.directives import KINDS, Confirm, Withdraw
from ground.commands.renewal import PARTS
from ground.telemetry import read_run, text_of
from tests.deploy.boards import FakeBoard
from tests.deploy.renewed_board import RenewedBoard
from tests.deploy.renewed_ends import SOCKET, RenewedEnds, linked_text
from tests.deploy.scripts import DEPLOY, ROOT, script
from tests.studies.command import command, say, scratch

KIND = KINDS.index("release")
FLIGHT_S, KILLED_AFTER_S = 2.0, 12.0
"""Duration (s) of each flight, and time (s) after which the first attempt to build is killed."""
_UNFLYABLE = """
import sys

if "run" in sys.argv and any(word.endswith("board.yaml") for word in sys.argv):
    raise SystemExit("this release cannot fly")
"""
"""Statements that end a flight with the board's configuration at once, and leave other commands working."""


class RealBoard(FakeBoard):
    """Files of a board whose releases are built, installed and run by a real Python interpreter."""

    def python(self, label: str) -> Path:
        """Return the Python interpreter that builds releases."""
        del label
        return Path(sys.base_prefix, "bin", f"python3.{sys.version_info.minor}")

    def install(self, label: str) -> str:
        """Build the first release from the packages of this environment, and install it."""
        python = str(self.python(label))
        program = [python, str(DEPLOY / "build_release.py"), str(self.prefix)]
        self._copy_packages(self.prefix / "releases/packages")
        build = [*program, "build", "--python", python, "--reuse", "packages"]
        done = subprocess.run(build, capture_output=True, text=True, check=True)
        subprocess.run([*program, "switch", done.stdout.split()[-1]], check=True)
        # The installer finds this release in its folder, and installs all other files.
        return super().install(label)

    @staticmethod
    def _copy_packages(release: Path) -> None:
        """Copy the board's packages into a folder that looks like a release."""
        lock = (DEPLOY / "requirements.lock").read_text(encoding="utf-8")
        site = release / "venv" / Path(sysconfig.get_path("purelib")).relative_to(sys.prefix)
        site.mkdir(parents=True)
        for name, version in re.findall(r"^([\w.-]+)==(\S+)", lock, re.MULTILINE):
            package = distribution(name)
            if package.version != version:
                raise SystemExit(
                    f"{name} {package.version} is installed, the board's lock file has {version}"
                )
            for file in package.files or ():
                if file.parts[0] != ".." and "__pycache__" not in file.parts:
                    (site / file).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(str(file.locate()), site / file)
        shutil.copyfile(DEPLOY / "requirements.lock", release / "requirements.lock")
        releases = script("releases")
        (release / "manifest").write_text(releases.manifest_text(release), encoding="utf-8")

    def fly(self, *program: str) -> tuple[str, str]:
        """Start the flight by its launcher; return the version (empty without a start) and the messages."""
        state = self.root / "state"
        state.mkdir(exist_ok=True)
        text = (self.root / "etc/knightcube/flight.yaml").read_text(encoding="utf-8")
        config, run = state / "board.yaml", state / "run"
        config.write_text(text.replace(SOCKET, str(state / "socket")), encoding="utf-8")
        shutil.rmtree(run, ignore_errors=True)
        words = [*(program or [str(self.prefix / "bin/fly")]), "run", str(config)]
        words += ["--duration", str(FLIGHT_S), "--out", str(run)]
        own = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
        own["STATE_DIRECTORY"] = str(state)
        done = subprocess.run(words, env=own, cwd=state, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            return "", done.stderr
        return text_of(read_run(run)["run"][0]["software"]), done.stderr


class RealReleases(RenewedBoard):
    """A board with real releases, and the ground station that signs them."""

    def __init__(self, place: Path) -> None:
        super().__init__(place)
        self.files = RealBoard(self.root, place / "flight.yaml")

    def sources(self, version: str, added: str = "") -> Path:
        """Return a copy of the repository's sources that has another version and the statements `added`."""
        folder = self.place / f"source-{version}"
        for part in PARTS:
            if (ROOT / part).is_dir():
                shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
            elif (ROOT / part).is_file():
                shutil.copyfile(ROOT / part, folder / part)
        for name in ("pyproject.toml", "knightcube/pyproject.toml", "flight/__init__.py"):
            path = folder / name
            text = path.read_text(encoding="utf-8").replace(__version__, version)
            path.write_text(text + (added if name.endswith("__init__.py") else ""), encoding="utf-8")
        return folder


class Rehearsal:
    """Steps of the benchmark, and for each step its duration and the version in use after it."""

    def __init__(self, place: Path) -> None:
        self._begun = time.monotonic()
        self.board = RealReleases.make(place / "board", linked_text())
        self.ends = RenewedEnds(self.board, 1)
        self.steps: list[dict[str, object]] = []
        self.board.step()
        self.note(f"install.sh installs {__version__}")

    def note(self, step: str, **facts: object) -> None:
        """Start the flight, and print a step of the benchmark."""
        seconds = round(time.monotonic() - self._begun, 1)
        flown = self.ends.flown_release()
        row = {"step": step, "flies": flown, "answers": self.ends.answers(), "s": seconds, **facts}
        self.steps.append(row)
        say(**row)
        self._begun = time.monotonic()

    def activate(self, version: str, number: int, added: str = "", killed: bool = False) -> None:
        """Sign, send and activate a release, and make the privileged program build it."""
        bundle = self.board.bundle("release", self.board.sources(version, added), number)
        self.ends.activate(bundle, "release", 2.0)
        if killed:
            process = subprocess.Popen(
                self.board.words(), env=self.board.environment(), start_new_session=True
            )
            time.sleep(KILLED_AFTER_S)
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        self.advance()
        self.note(f"{version} is activated", bundle_bytes=bundle.stat().st_size, killed=killed)

    def command(self, directive: Confirm | Withdraw, step: str) -> None:
        """Send a command about the release, and record the version in use after it."""
        self.ends.ask(directive)
        self.ends.turn(1.5)
        self.advance()
        self.note(step)

    def advance(self, seconds: float = 10.0) -> None:
        """Run a step of the privileged program, restart flight and link, and make the link report."""
        sys.stderr.write(self.board.step(seconds))
        self.ends.services()
        self.ends.turn(1.5)


@command
def main() -> int:
    """Renew the releases. Returns 0 if the expected release is in use after each step."""
    minor, _, patch = __version__.rpartition(".")
    second, third = (f"{minor}.{int(patch) + number}" for number in (1, 2))
    with scratch() as folder:
        rehearsal = Rehearsal(folder)
        with closing(rehearsal.ends):
            rehearsal.activate(second, 1, killed=True)
            rehearsal.command(Confirm(KIND), f"{second} is confirmed")
            rehearsal.command(Withdraw(KIND), f"{second} is withdrawn")
            rehearsal.command(Withdraw(KIND), f"{__version__} is withdrawn")
            rehearsal.activate(third, 2, _UNFLYABLE)
            rehearsal.advance()
            rehearsal.note(f"{third} has ended its trial")
            reports = rehearsal.ends.reports()
    flown = [step["flies"] for step in rehearsal.steps]
    wanted = [__version__, second, second, __version__, second, "", second]
    texts = [report.text for report in reports if report.name in {"activate", "withdraw"}]
    say(flown=flown, wanted=wanted, reports=texts)
    return int(flown != wanted or not all(step["answers"] for step in rehearsal.steps))
