"""Answers of a commanded flight that several tests read."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from ground.telemetry import Run
from tests.scenario.mode_flights import commanded
from tests.support.flights import Rigged, fly


class Script:
    """A channel that says prepared datagrams at prepared times and keeps the answers."""

    name = "socket"

    def __init__(self) -> None:
        self.due: list[bytes] = []
        self.answers: list[bytes] = []
        self.happened = "its file was gone"

    def say(self, data: bytes) -> None:
        self.due.append(data)

    def poll(self) -> list[tuple[bytes, Any]]:
        said, self.due = self.due, []
        return [(data, "somebody") for data in said]

    def news(self) -> str:
        news, self.happened = self.happened, ""
        return news

    def answer(self, data: bytes, sender: Any) -> None:
        assert sender == "somebody"
        self.answers.append(data)

    def close(self) -> None:
        pass


def said(folder: Path, *script: tuple[float, bytes]) -> tuple[Run, Script]:
    """Fly while datagrams come at mission times in s."""
    channel = Script()

    def prepare(rigged: Rigged) -> None:
        commanding = rigged.loop._tasks.commanding
        assert commanding is not None
        commanding._channels = (channel,)
        for at, data in script:
            rigged.at(at, partial(channel.say, data))

    far = {"at": 1e6, "mode": "safe"}  # a time line, so that the commands' group runs
    return fly(commanded(4.0, far), folder, prepare), channel
