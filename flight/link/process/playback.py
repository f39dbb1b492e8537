"""Playback of the archive: begun and ended by commands, reported when all of it is down."""

from __future__ import annotations

from dataclasses import replace

from flight.link.process.archive_reader import LogFollower, stretch
from flight.link.process.directives import Play
from flight.link.process.downlink import Downlink
from flight.link.process.verification import Report, Stage


class Playback:
    """At most one stretch at a time goes down."""

    def __init__(self, downlink: Downlink, log: LogFollower) -> None:
        self._downlink = downlink
        self._log = log
        self._done: Report | None = None

    def begin(self, play: Play, done: Report) -> list[Report]:
        """Begin a playback, at whose end `done` is reported; return the reports of now."""
        folder = self._log.folder(play.run)
        if folder is None:
            return [replace(done, stage=Stage.FAILED, text=f"there is no run {play.run}")]
        reports = self.end("another takes its place")
        self._downlink.play(stretch(folder, play.begin, play.end))
        self._done = done
        return [*reports, replace(done, stage=Stage.STARTED)]

    def end(self, reason: str) -> list[Report]:
        """End the playback; return the report of one that went on."""
        reports = [] if self._done is None else [replace(self._done, stage=Stage.FAILED, text=reason)]
        self._done = None
        self._downlink.play(None)
        return reports

    def turn(self) -> list[Report]:
        """Return the report of a playback that is all down."""
        if self._done is None or self._downlink.playing:
            return []
        done, self._done = self._done, None
        return [done]
