"""The release that a board flies: proves it after a minute of flight, and reports why another one was left.

`deploy/releases.py` chooses the release before any of this runs and counts its starts in the same file of the
state folder; `deploy/fly` passes the name of the release and the reasons in the environment.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from flight.loop.state.files import LinuxFiles, replace_file
from flight.loop.state.opening import service_folder
from hal.interfaces.wires import SECOND_NS, Clock

NAME, NOTE = "KNIGHTCUBE_RELEASE", "KNIGHTCUBE_RELEASE_NOTE"
TRIALS = "releases.json"
PROVEN_NS = 60 * SECOND_NS
"""After this flight time a release is proven: power cuts and crashes no longer count against it."""
_KEPT = 4


class Release:
    """The release of this flight; without a name there is nothing to prove."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Take the process's environment."""
        self._name = environment.get(NAME, "")
        self.note = environment.get(NOTE, "")
        folder = service_folder(environment)
        self._path = folder / TRIALS if folder is not None and self._name else None
        self._done = False

    def serve(self, clock: Clock, stack: ExitStack) -> None:
        """Prove the release in time, outside the loop, until `stack` is closed."""
        if self._path is not None:
            stack.callback(clock.ticker("release", PROVEN_NS, self.prove).stop)

    def prove(self) -> None:
        """Write that this release has flown; a failed write is retried a minute later."""
        if self._path is None or self._done:
            return
        with suppress(OSError):
            proven = [name for name in _proven(self._path) if name != self._name]
            self._write([*proven, self._name][-_KEPT:])
            self._done = True

    def end(self) -> None:
        """Forgive the starts of a release that ends by itself, proven or not."""
        if self._path is not None:
            with suppress(OSError):
                self._write(_proven(self._path))

    def _write(self, proven: list[str]) -> None:
        assert self._path is not None
        text = json.dumps({"starts": {}, "proven": proven})
        replace_file(LinuxFiles(), self._path, text.encode())


def _proven(path: Path) -> list[str]:
    """Return the releases that were proven; none where the file is missing or damaged."""
    with suppress(OSError, ValueError, TypeError, LookupError, RecursionError):
        kept: dict[str, Any] = json.loads(LinuxFiles().read(path) or b"")
        return [str(name) for name in kept["proven"]]
    return []
