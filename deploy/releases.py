"""Chooses the release that flies, and becomes it: `releases.py fly CONFIG ...`, run by `fly`.

Releases stand side by side in /opt/knightcube/releases; `current` and `previous` are links to two of them.
The current release flies, unless it is damaged and the previous one is whole, or it is new and `UNCLEAN`
starts ended before it was proven: then the previous release flies, and reports why. A flight proves its
release by flying for a minute. Nothing here may keep a board from flying: whatever fails, one is started.

`releases.py verify` reads every file of both releases. Standard library only: any Python runs it.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

UNCLEAN = 3
"""Starts in a row after which a release that was never proven is left out."""
MANIFEST, TRIALS = "manifest", "releases.json"
DAMAGED = (ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RecursionError)
"""What reading a record raises that holds anything: another shape, `Infinity`, a deep nest."""
NAME, NOTE = "KNIGHTCUBE_RELEASE", "KNIGHTCUBE_RELEASE_NOTE"
_OURS = re.compile(r"(?!venv/)|venv/lib/python[^/]*/site-packages/(flight|hal|sim_hal)/")


def files_of(release: Path) -> Iterator[Path]:
    """Yield the files of a release that its manifest lists: not those of a linked virtual environment."""
    for folder, folders, names in os.walk(release):
        folders.sort()
        yield from (Path(folder, name) for name in sorted(names) if Path(folder, name) != release / MANIFEST)


def manifest_text(release: Path) -> str:
    """Return the manifest: SHA-256, size and path of each file, and first the SHA-256 of these lines."""
    lines = [
        f"{_sum(path)} {path.stat().st_size} {path.relative_to(release).as_posix()}\n"
        for path in files_of(release)
        if not path.is_symlink()
    ]
    text = "".join(lines)
    return f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}"


def damage(release: Path, thorough: bool = False) -> str:
    """Return what a release lacks of its manifest, "" for a whole one.

    Our own files are read, those of libraries only compared in size unless `thorough`.
    """
    try:
        first, _, rest = (release / MANIFEST).read_text(encoding="utf-8").partition("\n")
        if hashlib.sha256(rest.encode()).hexdigest() != first:
            return "its manifest is damaged"
        for line in rest.splitlines():
            expected, size, name = line.split(" ", 2)
            path = release / name
            if path.stat().st_size != int(size):
                return f"{name} has another size"
            if (thorough or _OURS.match(name)) and _sum(path) != expected:
                return f"{name} is damaged"
    except (OSError, ValueError) as error:
        return f"{type(error).__name__}: {error}"
    return ""


def _sum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def linked(prefix: Path, link: str) -> Path | None:
    """Return the release that a link names, None without a complete one."""
    try:
        release = prefix / "releases" / Path(os.readlink(prefix / link)).name
    except OSError:
        return None
    return release if (release / MANIFEST).is_file() else None


class Trials:
    """The starts of releases that are not proven yet, kept in the state folder; the flight writes it too."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / TRIALS
        self.starts: dict[str, int] = {}
        self.proven: list[str] = []
        # Whatever stands in the file, the flight starts: a damaged count is no count.
        with suppress(OSError, *DAMAGED):
            kept = json.loads(self._path.read_text(encoding="utf-8"))
            starts = {str(name): int(count) for name, count in kept["starts"].items()}
            self.proven = [str(name) for name in kept["proven"]]
            self.starts = starts

    def failed(self, release: Path) -> bool:
        """Return whether a new release has had its starts."""
        return release.name not in self.proven and self.starts.get(release.name, 0) >= UNCLEAN

    def count(self, release: Path) -> None:
        """Count a start of a release that is not proven; a folder that cannot be written is no obstacle."""
        if release.name in self.proven:
            return
        self.starts[release.name] = min(self.starts.get(release.name, 0) + 1, UNCLEAN)
        with suppress(OSError):
            beside = self._path.with_suffix(".part")
            with beside.open("w", encoding="utf-8") as file:
                json.dump({"starts": self.starts, "proven": self.proven}, file)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(self._path)


def choose(prefix: Path, trials: Trials) -> tuple[list[Path], str]:
    """Return the releases to try, the best first, and the reason where the current one is not the first."""
    found = [release for link in ("current", "previous") if (release := linked(prefix, link)) is not None]
    if not found:
        return [], ""
    current, reasons = found[0], []
    if len(found) > 1 and trials.failed(current) and not trials.failed(found[1]):
        reasons.append(f"release {current.name} ended {UNCLEAN} times before it was proven")
        found.reverse()
    for number, release in enumerate(found):
        if not (problem := damage(release)):
            found.insert(0, found.pop(number))
            break
        reasons.append(f"release {release.name}: {problem}")
    return found, "; ".join([*reasons, f"{found[0].name} flies"]) if reasons else ""


def fly(prefix: Path, arguments: list[str], environment: Mapping[str, str]) -> int:
    """Become the flight; return only where no release can be started."""
    state = Path(environment.get("STATE_DIRECTORY", "/var/lib/knightcube").split(":")[0])
    trials = Trials(state)
    try:
        releases, note = choose(prefix, trials)
        if releases:
            trials.count(releases[0])
    except Exception as error:  # noqa: BLE001 - whatever is wrong here, the current release flies
        releases, note = [], f"the choice of a release failed: {error}"
    if note:
        sys.stderr.write(f"fly: {note}\n")
    for release in (*releases, prefix / "current", prefix / "previous"):
        python = str(release / "venv/bin/python")
        words = {NAME: release.name, NOTE: note}
        with suppress(OSError):
            os.execve(python, [python, "-m", "flight", "run", *arguments], {**environment, **words})
    sys.stderr.write(f"fly: no release in {prefix} can be started\n")
    return 1


def main(words: list[str]) -> int:
    """Fly, or verify both releases; 2 for wrong use."""
    prefix = Path(__file__).resolve().parent.parent
    if words[:1] == ["fly"]:
        return fly(prefix, words[1:], os.environ)
    if words != ["verify"]:
        sys.stderr.write("usage: releases.py fly CONFIG [OPTIONS] | releases.py verify\n")
        return 2
    problems = 0
    for link in ("current", "previous"):
        release = linked(prefix, link)
        problem = damage(release, thorough=True) if release is not None else ""
        sys.stdout.write(f"{link}: {release.name if release else 'none'} {problem or 'whole'}\n")
        problems += bool(problem)
    return int(problems > 0)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
