"""Runs this project's code of any revision: a checkout of a commit, and Python processes in it.

The results of a revision are cached, because they depend only on the revision, the machine and the
interpreter with its libraries.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path

from knightcube.errors import UsageError

_LIMIT = 3600.0  # timeout (s) of one process
# An editable installation of the project provides modules that a checkout lacks, so its finders are removed.
_ONLY_HERE = """
import sys
sys.meta_path = [finder for finder in sys.meta_path if "editable" not in str(finder).lower()]
"""


class CheckoutError(UsageError):
    """Error for a revision that cannot be checked out, or for a failed process in a checkout."""


def repository() -> Path:
    """Return the root of this checkout."""
    return Path(__file__).resolve().parents[3]


def resolve(revision: str) -> str:
    """Return the full hash of a commit. Raises CheckoutError if git does not have the revision."""
    return _git("rev-parse", "--verify", f"{revision}^{{commit}}").strip()


def check_out(commit: str, folder: Path) -> None:
    """Write the files of a commit into an empty folder."""
    archive = folder.with_suffix(".tar")
    _git("archive", "--format=tar", f"--output={archive}", commit)
    folder.mkdir(exist_ok=True)
    subprocess.run(["tar", "--extract", f"--file={archive}", f"--directory={folder}"], check=True)
    archive.unlink()


def run_script(checkout: Path, script: str, *arguments: str, folder: Path | None = None) -> str:
    """Return the output of a Python script that imports only the checkout's modules; it runs in `folder`.

    Raises CheckoutError if its exit status is not 0.
    """
    return run_python(checkout, "-c", _ONLY_HERE + script, *arguments, folder=folder)


def run_python(checkout: Path, *arguments: str, folder: Path | None = None) -> str:
    """Return the output of the interpreter in `folder` (default: the checkout).

    The checkout's modules take precedence over installed modules. Raises CheckoutError if the exit status is
    not 0.
    """
    try:
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=folder or checkout,
            env={**os.environ, "PYTHONPATH": str(checkout), "KNIGHTCUBE_COMPILED": "0"},
            capture_output=True,
            text=True,
            timeout=_LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise CheckoutError(f"not done after {_LIMIT:g} s") from error
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no message"]
        raise CheckoutError(f"exit status {done.returncode}: {lines[-1]}")
    return done.stdout


def cache_folder(root: Path, commit: str, name: str, key: object) -> Path:
    """Return the cache folder of a run: commit, name, and a hash of key, machine and libraries."""
    text = json.dumps([key, _machine(), sys.version, _libraries()])
    return root / commit[:12] / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def _machine() -> str:
    """Return the name of the processor; linear algebra libraries select their code by it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return " ".join([platform.machine(), *models[:1]])


def _libraries() -> list[str]:
    names = ("numpy", "scipy", "nlopt", "msgspec", "pyerfa", "pyyaml", "pillow")
    found = []
    for name in names:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    return found


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=repository(), capture_output=True, text=True, check=False)
    if done.returncode:
        raise CheckoutError(f"git {arguments[0]}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}")
    return done.stdout
