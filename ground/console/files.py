"""Files of the satellite for the console, from the folder of a run or by CFDP over a link."""

from __future__ import annotations

import json
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, TypeVar

from flight.link.files.store import Store, problem_of_name
from flight.link.process.commanding import Stage
from flight.link.process.directives import KINDS, ListFiles, SendFile
from flight.link.process.filing import LISTING
from ground.console.commanding import LinkFeed
from ground.link.commanding import FileSession, failed, sha256_of
from knightcube.errors import FlightError, UsageError

Object = dict[str, Any]
_T = TypeVar("_T")
_RATE = 40_000.0  # maximum rate of frames to the satellite (bytes/s)
_SILENCE_S = 30.0  # Time (s) without telemetry after which a transfer fails. The received data is kept.
_POLL_S = 0.05
_LINGER_S = 0.5
"""Time (s) after a transfer during which the satellite may request a repetition of the last answer."""
_MOST_FILES = 2000  # largest number of files in the list of a run's folder


class Files(Protocol):
    """Protocol for the files of a satellite, which the page lists and fetches."""

    puts: bool

    def listing(self) -> Object:
        """Return the files as {"files": [{"name", "bytes"}, ...]}. Raises FlightError."""

    def get(self, name: str) -> Path:
        """Return the local copy of a file. Raises FlightError, and UsageError for an invalid name."""

    def put(self, kind: str, name: str, data: bytes) -> Object:
        """Upload a file to the satellite. Raises FlightError, and UsageError for an invalid name."""


class RunFiles:
    """Files in the folder of a run."""

    puts = False

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def listing(self) -> Object:
        """Return the files of the folder and its subfolders."""
        paths = [path for path in sorted(self._folder.rglob("*")) if path.is_file() and not path.is_symlink()]
        files = [
            {"name": path.relative_to(self._folder).as_posix(), "bytes": path.stat().st_size}
            for path in paths[:_MOST_FILES]
        ]
        return {"files": files}

    def get(self, name: str) -> Path:
        """Return the path of a file. Raises UsageError if the folder has no file of this name."""
        if all(name != file["name"] for file in self.listing()["files"]):
            raise UsageError(f"{name!r:.80}: the run has no such file")
        return self._folder / name

    def put(self, kind: str, name: str, data: bytes) -> Object:
        """Raise UsageError, because files can be uploaded to a satellite only over its link."""
        raise UsageError(f"{kind}/{name}: uploading files to a satellite needs its link: start with --link")


class LinkFiles:
    """Files of a satellite over its link. Requests are executed one at a time."""

    puts = True

    def __init__(self, feed: LinkFeed, folder: Path) -> None:
        self._feed, self._folder = feed, folder
        self._one = threading.Lock()

    def listing(self) -> Object:
        """Request the list of files and return it. Raises FlightError."""
        found: Object = json.loads(self._request(ListFiles(), LISTING).read_bytes())
        return found

    def get(self, name: str) -> Path:
        """Request a file and return its local copy. Raises FlightError and UsageError."""
        if problem := problem_of_name(name):
            raise UsageError(f"{name!r:.80}: {problem}")
        return self._request(SendFile(name), name)

    def put(self, kind: str, name: str, data: bytes) -> Object:
        """Upload a file to the satellite and return its name, size and SHA-256. Raises FlightError."""
        full = f"{kind}/{name}"
        problem = problem_of_name(full) or ("" if kind in KINDS else f"the kind is one of {', '.join(KINDS)}")
        if problem:
            raise UsageError(f"{full!r:.80}: {problem}")
        with tempfile.TemporaryDirectory(prefix="knightcube-") as place:
            path = Path(place) / name
            path.write_bytes(data)

            def send(session: FileSession) -> None:
                with self._feed.lock:
                    begun = session.put(path, full, time.monotonic_ns())
                self._wait(lambda: self._ended(session, begun.number))

            self._with_session(send)
            return {"name": f"received/{full}", "bytes": len(data), "sha256": sha256_of(path).hex()}

    def _request(self, directive: ListFiles | SendFile, name: str) -> Path:
        def receive(session: FileSession) -> Path:
            with self._feed.lock:
                session.ask(directive, time.monotonic_ns())
            self._wait(lambda: self._received(session, name))
            until = time.monotonic() + _LINGER_S
            while session.entity.transfers() and time.monotonic() < until:
                time.sleep(_POLL_S)
            return session.received / name

        return self._with_session(receive)

    def _with_session(self, work: Callable[[FileSession], _T]) -> _T:
        store = Store(self._folder)
        with self._one, store.owned(), self._feed.transferring(store, _RATE) as session:
            return work(session)

    def _wait(self, done: Callable[[], bool]) -> None:
        """Wait until `done` returns true. Raises FlightError after a long silence."""
        while True:
            with self._feed.lock:
                if done():
                    return
            if self._feed.silence > _SILENCE_S:
                raise FlightError(f"no telemetry for {_SILENCE_S:g} s; the received data is kept")
            time.sleep(_POLL_S)

    @staticmethod
    def _received(session: FileSession, name: str) -> bool:
        """Return whether a file has been received completely. Raises FlightError with the reason if not."""
        reports = session.reports()
        if problem := failed(reports):
            raise FlightError(problem)
        completed = any(report.stage is Stage.COMPLETED for report in reports)
        for ending in [one for one in session.entity.ended if one.name == name]:
            session.entity.ended.remove(ending)
            if ending.condition != 0:
                raise FlightError(f"{name}: {session.reason_of(ending)}")
            completed = True
        return completed

    @staticmethod
    def _ended(session: FileSession, number: int) -> bool:
        """Return whether a file was sent completely. Raises FlightError with the reason if not."""
        for ending in [one for one in session.entity.ended if one.number == number]:
            if ending.condition != 0:
                raise FlightError(f"{ending.name}: {session.reason_of(ending)}")
            return True
        return False
