"""Chooses the software release to run: `releases.py choose` prints the release's name and the reason.

The releases are folders in /opt/knightcube/releases, and the links `current` and `previous` select two of
them. The current release is chosen unless it is damaged, or was started `UNCLEAN` times without being proven.
If the current release is not chosen, the program prints the reason, and chooses the previous release if it is
intact. A release is proven after its flight software has run for a minute. The script `fly` runs this
program, and chooses a release itself if this program fails.

The command `releases.py verify` checks every file of both releases. Any Python interpreter can run this
program, which needs only the standard library.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import sys
import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

UNCLEAN = 3
"""Number of starts after which an unproven release is no longer chosen."""
TRIES = 3
"""Number of attempts to read the record of starts."""
MANIFEST, TRIALS = "manifest", "releases.json"
INCOMPLETE = "does not point to a complete release"
DAMAGED = (ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RecursionError)
"""Exceptions that a damaged JSON record can cause."""
LARGEST_RECORD, LARGEST_MANIFEST = 1 << 16, 1 << 24
"""Maximum sizes (bytes) of a record and of a manifest."""
_OURS = re.compile(r"(?!venv/)|venv/lib/python[^/]*/site-packages/(flight|hal|knightcube|sim_hal)/")


def files_of(release: Path) -> Iterator[Path]:
    """Yield the files of a release, except its manifest and the files in folders that are symbolic links."""
    for folder, folders, names in os.walk(release):
        folders.sort()
        yield from (Path(folder, name) for name in sorted(names) if Path(folder, name) != release / MANIFEST)


def manifest_text(release: Path) -> str:
    """Return the manifest: first the SHA-256 of its other lines, then SHA-256, size and path of each file."""
    lines = [
        f"{_sum(path)} {path.stat().st_size} {path.relative_to(release).as_posix()}\n"
        for path in files_of(release)
        if not path.is_symlink()
    ]
    text = "".join(lines)
    return f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}"


def damage(release: Path, thorough: bool = False) -> str:
    """Return how a release differs from its manifest, or an empty text for an intact release.

    The files of libraries are compared only by size, unless `thorough` is true.
    """
    try:
        first, _, rest = _text(release / MANIFEST, LARGEST_MANIFEST).partition("\n")
        if hashlib.sha256(rest.encode()).hexdigest() != first:
            return "its manifest is damaged"
        for line in rest.splitlines():
            expected, size, name = line.split(" ", 2)
            path = release / name
            found = path.stat()
            if not stat.S_ISREG(found.st_mode) or found.st_size != int(size):
                return f"{name} has another size"
            if (thorough or _OURS.match(name)) and _sum(path) != expected:
                return f"{name} is damaged"
    except (OSError, ValueError) as error:
        return f"{type(error).__name__}: {error}"
    return ""


def _sum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _text(path: Path, largest: int) -> str:
    """Return the text of a file.

    Raises OSError for a file of more than `largest` bytes, which could fill the memory, and for a FIFO, from
    which reading might never end. Raises ValueError for text that is not UTF-8.
    """
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), encoding="utf-8") as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode) or found.st_size > largest:
            raise OSError(f"{path} is not a regular file of at most {largest} bytes")
        return file.read()


def record(line: str) -> str:
    """Return a line and its CRC-32, in the format of flight/link/files/store.py."""
    crc = zlib.crc32(f"{line}\n".encode())
    return f"{line}\n{crc:08x}\n"


def _line_of(text: str) -> str:
    line = text.partition("\n")[0]
    if record(line) != text:
        raise ValueError("its CRC-32 is wrong")
    return line


def linked(prefix: Path, link: str) -> Path | None:
    """Return the release to which a symbolic link points, or None if the release is incomplete."""
    try:
        release = prefix / "releases" / Path(os.readlink(prefix / link)).name
    except OSError:
        return None
    return release if (release / MANIFEST).is_file() else None


class Trials:
    """Number of starts of each unproven release, stored in a file that the flight software also writes."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / TRIALS
        self.starts: dict[str, int] = {}
        self.proven: list[str] = []
        # A damaged file is ignored, so that the flight software can start.
        with suppress(OSError, *DAMAGED):
            kept = json.loads(_line_of(self._persistently_read()))
            starts = {str(name): int(count) for name, count in kept["starts"].items()}
            self.proven = [str(name) for name in kept["proven"]]
            self.starts = starts

    def _persistently_read(self) -> str:
        """Return the text of the record. Raises OSError and ValueError.

        Several attempts are made, because a single failed disk access does not mean damage. If the record
        were ignored, the next write would discard the list of proven releases.
        """
        for _ in range(TRIES - 1):
            with suppress(OSError):
                return _text(self._path, LARGEST_RECORD)
        return _text(self._path, LARGEST_RECORD)

    def failed(self, release: Path) -> bool:
        """Return whether an unproven release has been started `UNCLEAN` times."""
        return release.name not in self.proven and self.starts.get(release.name, 0) >= UNCLEAN

    def count(self, release: Path) -> None:
        """Count and store a start of an unproven release, ignoring write errors."""
        if release.name in self.proven:
            return
        self.starts[release.name] = min(self.starts.get(release.name, 0) + 1, UNCLEAN)
        with suppress(OSError):
            beside = self._path.with_suffix(".part")
            beside.unlink(missing_ok=True)  # opening a FIFO of this name would block
            with beside.open("w", encoding="utf-8") as file:
                file.write(record(json.dumps({"starts": self.starts, "proven": self.proven})))
                file.flush()
                os.fsync(file.fileno())
            beside.replace(self._path)


def choose(prefix: Path, trials: Trials) -> tuple[Path | None, str]:
    """Return the release to run, and the reason if the current release is damaged, missing or not chosen."""
    current, previous = linked(prefix, "current"), linked(prefix, "previous")
    found = [release for release in (current, previous) if release is not None]
    if not found:
        return None, ""
    reasons = [] if current is not None else [f"the symbolic link `current` {INCOMPLETE}"]
    if len(found) > 1 and trials.failed(found[0]) and not trials.failed(found[1]):
        reasons.append(f"release {found[0].name} ended {UNCLEAN} times within a minute of its start")
        found.reverse()
    chosen = found[0]
    for release in found:
        if not (problem := damage(release)):
            chosen = release
            break
        reasons.append(f"release {release.name}: {problem}")
    return chosen, "; ".join([*reasons, f"{chosen.name} flies"]) if reasons else ""


def answer(prefix: Path, environment: Mapping[str, str]) -> int:
    """Print the chosen release and the reason, and count its start; return 1 if there is no release."""
    trials = Trials(Path(environment.get("STATE_DIRECTORY", "/var/lib/knightcube").split(":")[0]))
    release, note = choose(prefix, trials)
    if release is None:
        return 1
    # The release is printed first, because `fly` may kill this process while it waits for the disk.
    sys.stdout.write(f"{release.name} {note}\n")
    sys.stdout.flush()
    trials.count(release)
    return 0


def main(words: list[str]) -> int:
    """Choose a release or verify both releases, and return the exit status, which is 2 for bad arguments."""
    prefix = Path(__file__).resolve().parent.parent
    if words == ["choose"]:
        return answer(prefix, os.environ)
    if words != ["verify"]:
        sys.stderr.write("usage: releases.py choose | releases.py verify\n")
        return 2
    problems = 0
    for link in ("current", "previous"):
        release = linked(prefix, link)
        if release is not None:
            problem = damage(release, thorough=True)
            sys.stdout.write(f"{link}: {release.name} {problem or 'whole'}\n")
        else:  # before the first update, no previous release exists
            problem = INCOMPLETE if link == "current" or os.path.lexists(prefix / link) else ""
            sys.stdout.write(f"{link}: none {problem}".rstrip() + "\n")
        problems += bool(problem)
    return int(problems > 0)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
