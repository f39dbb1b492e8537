"""Builds a software release beside the release in use, tests it, and switches to it by one rename.

The script install.sh calls `build_release.py PREFIX build|switch|rollback`. The manifest of a release is
written last, so a release with a manifest is complete, and only complete releases are linked. Each build
first removes the incomplete releases of interrupted builds, so only one build runs at a time. The script
needs only Python's standard library.
"""

from __future__ import annotations

import argparse
import fcntl
import fnmatch
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from releases import MANIFEST, linked, manifest_text

SOURCE = "source"
"""File of a release with the SHA-256 digest of its sources and build options."""
LOCK = "requirements.lock"
"""Name of the lock file's copy in a release; the packages of the release were installed from this file."""
_NUMBER = ".number"
"""File with the number in the name of the newest release."""
SELF_TEST_S = 10
_PARTS = ("knightcube", "flight", "hal", "sim_hal", "deploy", "config/step_demo.yaml", "pyproject.toml")
_BOARD_LOCK = "deploy/requirements.lock"
_OURS = ("flight", "hal", "sim_hal", "knightcube", "knightcube*.dist-info")
"""File names of this repository's own packages. Each release builds these packages from its own sources."""
_NOT_BUILT = shutil.ignore_patterns(".*", "build", "runs", "tests", "*.egg-info", "__pycache__")
"""Names in the source folder that are not sources, such as caches, which change while a release is used."""


class Build:
    """Build of a release from this source folder; a dry run only prints the steps."""

    def __init__(self, prefix: Path, options: argparse.Namespace) -> None:
        self.releases = prefix / "releases"
        self._prefix = prefix
        self._source = Path(__file__).resolve().parents[1]
        self._options = options

    def make(self) -> int:
        """Build a release, unless the current release has the same sources, and print its name."""
        current = linked(self._prefix, "current")
        wanted = self._digest()
        if current is not None and _text(current / SOURCE) == wanted:
            sys.stdout.write(f"{current.name}\n")
            return 0
        release = self.releases / self._name()
        if not self._options.dry_run:
            self._remove_incomplete()
            release.mkdir(parents=True)
        try:
            self._fill(release, wanted)
        except BaseException:  # an incomplete release may have filled the disk
            with suppress(OSError):
                _remove(release)
            raise
        sys.stdout.write(f"{release.name}\n")
        return 0

    def _fill(self, release: Path, wanted: str) -> None:
        """Build and test a release from sources with the digest `wanted`."""
        self._test(self._environment(release))
        if not self._options.dry_run:
            (release / SOURCE).write_text(wanted, encoding="ascii")
            shutil.copyfile(self._source / _BOARD_LOCK, release / LOCK)
            _write(self._prefix / _NUMBER, f"{release.name.rpartition('+')[2]}\n")
            os.sync()  # the listed files must be on disk before the manifest
            _write(release / MANIFEST, manifest_text(release))

    def _environment(self, release: Path) -> Path:
        """Create the virtual environment of a release, and return the path of its Python interpreter."""
        options, venv = self._options, release / "venv"
        python = venv / "bin/python"
        if options.venv:
            if not options.dry_run:
                venv.symlink_to(Path(options.venv).resolve())
            return Path(options.venv) / "bin/python"
        found = ["--no-index", "--find-links", options.wheels] if options.wheels else []
        quiet = [python, "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
        self._run([options.python, "-m", "venv", venv])
        # The lock file includes the build backend, so pip verifies the hash of each package used in a build.
        if options.reuse:
            self._copy_packages(self.releases / options.reuse, release)
        else:
            self._run([*quiet, *found, "--require-hashes", "--no-deps", "-r", self._source / _BOARD_LOCK])
        with tempfile.TemporaryDirectory() as folder:
            # A killed build leaves files that later builds would include, so a copy of the sources is built.
            source = Path(folder) / "source" if not options.dry_run else self._source
            if not options.dry_run:
                shutil.copytree(self._source, source, symlinks=True, ignore=_NOT_BUILT)
            ours = ["--no-index", "--no-deps", "--no-build-isolation", source / "knightcube", source]
            self._run([*quiet, *ours])
        # The distribution also contains the ground tools, which are not used on a board.
        for ground in venv.glob("lib/python3*/site-packages/ground"):
            shutil.rmtree(ground)
        return python

    def _copy_packages(self, old: Path, release: Path) -> None:
        """Copy the packages of an older release, which must have been built from the same lock file."""
        if _text(old / LOCK) != _text(self._source / _BOARD_LOCK) or not _text(old / LOCK):
            sys.stderr.write(f"install: failed: {old.name} has other packages: add the folder wheels\n")
            raise SystemExit(1)
        if problem := _damaged_package(old):
            sys.stderr.write(f"install: failed: add the folder wheels, because {problem}\n")
            raise SystemExit(1)
        # Bytecode is not copied, because Python rejects bytecode whose source file has another time.
        caches = shutil.ignore_patterns("__pycache__")
        ours = shutil.ignore_patterns(*_OURS, "__pycache__")
        for packages in old.glob("venv/lib/python3*/site-packages"):
            place = release / packages.relative_to(old)
            for path in packages.iterdir():
                if path.name in ours(str(packages), [path.name]):
                    continue
                if path.is_dir():
                    shutil.copytree(path, place / path.name, ignore=caches, dirs_exist_ok=True)
                else:
                    shutil.copyfile(path, place / path.name)

    def _test(self, python: Path) -> None:
        """Test a release: import its modules, print its version, test its link, and fly for ten seconds."""
        self._run([python, "-c", "import flight.app.flight, flight.loop.worker"])
        self._run([python, "-c", "from flight.app.cli.link import self_test; self_test()"])
        self._run([python, "-m", "flight", "--version"])
        with tempfile.TemporaryDirectory() as folder:
            words = ["run", self._source / "config/step_demo.yaml", "--duration", SELF_TEST_S]
            self._run([python, "-m", "flight", *words, "--out", Path(folder) / "run"])

    def _run(self, words: Sequence[object]) -> None:
        """Run a command, or print it in a dry run; the output of a command is shown only if it fails."""
        command = [str(word) for word in words]
        if self._options.dry_run:
            sys.stdout.write(f"would run: {' '.join(command)}\n")
            return
        # The release is tested without the PYTHONPATH of this shell, because the service has none.
        own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        done = subprocess.run(
            command,
            cwd="/",
            env=own,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if done.returncode != 0:
            cause = (done.stdout.strip().splitlines() or [f"status {done.returncode}"])[-1]
            sys.stderr.write(f"{done.stdout}\ninstall: failed: {cause}: {' '.join(command)}\n")
            raise SystemExit(1)

    def _remove_incomplete(self) -> None:
        for release in sorted(self.releases.glob("*")):
            if not (release / MANIFEST).is_file():
                _remove(release)

    def _name(self) -> str:
        """Return a new release name: the version, and a number above those of all earlier releases.

        A removed release may have failed, so a new release of the same name would not be started.
        """
        text = (self._source / "pyproject.toml").read_text(encoding="utf-8")
        version = next(line.split('"')[1] for line in text.splitlines() if line.startswith("version = "))
        numbers = [int(path.name.rpartition("+")[2]) for path in self.releases.glob("*+*")]
        with suppress(OSError, ValueError):
            numbers.append(int((self._prefix / _NUMBER).read_text(encoding="ascii")))
        return f"{version}+{max(numbers, default=0) + 1}"

    def _digest(self) -> str:
        """Return the SHA-256 of the source files and of the build options."""
        options = self._options
        digest = hashlib.sha256(f"{options.python} {options.venv}\n".encode())
        for part in _PARTS:
            for path in _source_files(self._source / part):
                digest.update(f"{path.relative_to(self._source)}\n".encode() + path.read_bytes())
        return digest.hexdigest()


def _source_files(path: Path) -> Iterator[Path]:
    """Yield a file, or the files of a folder that a build copies, in the order of their names."""
    if path.is_file():
        yield path
    elif path.is_dir():
        names = sorted(os.listdir(path))
        for name in sorted(set(names) - _NOT_BUILT(str(path), names)):
            yield from _source_files(path / name)


def _damaged_package(release: Path) -> str:
    """Return how the package files of a release differ from its manifest, or an empty text if they agree."""
    try:
        first, _, rest = (release / MANIFEST).read_text(encoding="utf-8").partition("\n")
        if hashlib.sha256(rest.encode()).hexdigest() != first:
            return f"the manifest of {release.name} is damaged"
        for line in rest.splitlines():
            expected, _, name = line.split(" ", 2)
            parts = name.split("/")
            if parts[:2] != ["venv", "lib"] or "__pycache__" in parts:
                continue
            if any(fnmatch.fnmatch(part, pattern) for part in parts[4:5] for pattern in _OURS):
                continue
            path = release / name
            if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != expected:
                return f"{name} is damaged"
    except (OSError, ValueError) as error:
        return f"{release.name} cannot be read: {error}"
    return ""


def switch(prefix: Path, name: str) -> None:
    """Make a release current, make the former current release previous, and remove all other releases.

    If the former current release is incomplete or cannot be read, the previous release stays.
    """
    release, current = prefix / "releases" / name, linked(prefix, "current")
    if current == release:
        return
    if not (release / MANIFEST).is_file():
        raise SystemExit(f"install: {release} is not a complete release")
    os.sync()
    if current is not None:
        _link(prefix / "previous", current)
    _link(prefix / "current", release)
    kept = {name}
    with suppress(FileNotFoundError):
        kept.add(Path(os.readlink(prefix / "previous")).name)
    for other in (prefix / "releases").iterdir():
        if other.name not in kept:
            _remove(other)


def rollback(prefix: Path) -> str:
    """Swap the current and the previous release, and return the name of the new current release."""
    current, previous = linked(prefix, "current"), linked(prefix, "previous")
    if previous is None or previous == current:
        raise SystemExit("install: --rollback: there is no previous release")
    _link(prefix / "current", previous)
    if current is not None:
        _link(prefix / "previous", current)
    return previous.name


def _link(link: Path, release: Path) -> None:
    """Set a symbolic link to a release by one atomic rename."""
    beside = link.with_name(f".{link.name}.part")
    beside.unlink(missing_ok=True)
    beside.symlink_to(Path("releases") / release.name)
    beside.replace(link)
    _sync(link.parent)


def _remove(release: Path) -> None:
    """Remove a release, beginning with its manifest, without which the release counts as incomplete."""
    (release / MANIFEST).unlink(missing_ok=True)
    shutil.rmtree(release)


def _write(path: Path, text: str) -> None:
    beside = path.with_name(f"{path.name}.part")
    with beside.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)
    _sync(path.parent)


@contextmanager
def _alone(prefix: Path) -> Iterator[None]:
    """Hold the lock of builds. Raises SystemExit while another build runs, whose release would be removed."""
    prefix.mkdir(parents=True, exist_ok=True)
    with open(prefix / ".build", "a", encoding="ascii") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise SystemExit("install: failed: another build runs: try again after its end") from error
        yield


def _sync(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _text(path: Path) -> str:
    """Return the text of a file, or an empty string if the file is missing, damaged or unreadable."""
    with suppress(OSError, ValueError):
        return path.read_text(encoding="ascii")
    return ""


def main(words: list[str]) -> int:
    """Build, switch or roll back the releases in the folder that the arguments name."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("prefix", type=Path)
    parser.add_argument("action", choices=["build", "switch", "rollback"])
    parser.add_argument("name", nargs="?", help="with switch: the release")
    parser.add_argument("--python", default="python3")
    parser.add_argument("--wheels", default="")
    parser.add_argument("--venv", default="")
    parser.add_argument(
        "--reuse", default="", metavar="RELEASE", help="copy the installed packages of this release"
    )
    parser.add_argument("--dry-run", action="store_true")
    options = parser.parse_args(words)
    if options.action == "build":
        with _alone(options.prefix) if not options.dry_run else nullcontext():
            return Build(options.prefix, options).make()
    if options.action == "switch":
        switch(options.prefix, options.name)
    else:
        sys.stdout.write(f"{rollback(options.prefix)}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
