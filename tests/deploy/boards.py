"""Files of a board whose releases are installed within a second, because its Python makes empty environments.

The installer is given a script instead of a Python interpreter. The script makes virtual environments that
contain the script itself as Python interpreter, "installs" by writing one file, and prints its release
instead of starting a flight. The script passes all other programs, such as the modules of the installer, to
the real Python.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from flight import __version__
from flight.link.files.store import to_record
from tests.deploy.scripts import DEPLOY, ROOT, TESTBED

FIRST, SECOND = f"{__version__}+1", f"{__version__}+2"
"""Names of the first two releases that are installed from this repository."""
_PYTHON = f"""#!/bin/sh
home=$(dirname "$(dirname "$0")")
packages=$home/lib/python3/site-packages
case "$*" in
    *"-m venv "*)
        for folder; do :; done
        mkdir -p "$folder/bin" "$folder/lib/python3/site-packages/flight"
        ln "$(readlink -f "$0")" "$folder/bin/python"
        cp "$home/label" "$folder/label" ;;
    *"-m pip "*"-r "*) mkdir -p "$packages/numpy"; echo numpy >"$packages/numpy/numpy.py" ;;
    *"-m pip "*)
        mkdir -p "$packages/ground" "$packages/knightcube"
        cp "$home/label" "$packages/flight/label"
        cp "$home/label" "$packages/knightcube/label" ;;
    *"-m flight run /"*"step_demo.yaml"*) grep -q . "$packages/flight/label" ;;
    *"-m flight --version"* | *"import flight"* | *"import self_test"*) ;;
    *"-m flight run "* | *"-m flight link "*) echo "flies $(cat "$packages/flight/label")" ;;
    *)  # an isolated Python would not find the modules of this folder
        [ "$1" != -I ] || shift
        [ "$1" != -B ] || shift
        PYTHONPATH={ROOT} exec {sys.executable} "$@" ;;
esac
"""


def starts_record(starts: dict[str, int], *proven: str) -> bytes:
    """Return a release record with the numbers of starts of new releases, and the accepted releases."""
    return to_record(json.dumps({"starts": starts, "proven": proven}).encode())


@dataclass(frozen=True)
class FakeBoard:
    """Files of a board below `root`, and Python scripts that build releases with given labels."""

    root: Path
    config: Path = TESTBED

    @property
    def prefix(self) -> Path:
        """Installation folder of the software, `opt/knightcube`."""
        return self.root / "opt/knightcube"

    def python(self, label: str) -> Path:
        """Return a script that acts as a Python interpreter.

        The virtual environments that this interpreter makes contain the release `label`.
        """
        home = self.root.parent / f"python-{label}"
        path = home / "bin/python"
        if not path.exists():
            path.parent.mkdir(parents=True)
            (home / "label").write_text(label, encoding="ascii")
            path.write_text(_PYTHON, encoding="utf-8")
            path.chmod(0o755)
        return path

    def words(self, label: str) -> list[str]:
        """Return the command that installs a release."""
        options = ["--python", str(self.python(label)), "--config", str(self.config)]
        return ["sh", str(DEPLOY / "install.sh"), *options]

    def environment(self) -> dict[str, str]:
        """Return the environment of the installer."""
        return {**os.environ, "DESTDIR": str(self.root)}

    def install(self, label: str) -> str:
        """Install a release, and return the output."""
        words = self.words(label)
        done = subprocess.run(words, env=self.environment(), capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def unit_words(self, unit: str, setting: str = "ExecStart") -> list[str]:
        """Return the words of a unit's command up to the launcher, with the file paths of this board."""
        text = (DEPLOY / unit).read_text(encoding="utf-8").replace("\\\n", "")
        (line,) = re.findall(rf"^{setting}=-?(/bin/sh -c '.*)$", text, re.MULTILINE)
        return shlex.split(line.replace("$$", "$").replace("/opt/knightcube", str(self.prefix)))[:4]

    def fly(self, *program: str) -> tuple[str, str]:
        """Start the flight; return the label of the started release ("" for none) and the error output.

        The error output omits the line that reports an ordinary start of the current release. By default, the
        first copy of the launcher starts the flight; `program` replaces its command line, for example by the
        command of a unit.
        """
        state = self.root / "state"
        state.mkdir(exist_ok=True)
        words = [*(program or [str(self.prefix / "bin/fly")]), "run", "/etc/knightcube/flight.yaml"]
        own = {**os.environ, "STATE_DIRECTORY": str(state)}
        done = subprocess.run(words, env=own, cwd=state, capture_output=True, text=True, check=False)
        complaints = re.sub(r"fly: release \S+ flies \(whole\): releases.py chose it\n", "", done.stderr)
        return done.stdout.removeprefix("flies ").strip(), complaints
