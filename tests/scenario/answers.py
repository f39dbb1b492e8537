"""Replies to commands in a simulated flight, shared by several tests."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from ground.telemetry import Run
from tests.scenario.mode_flights import commanded
from tests.support.flights import Rigged, fly


class Script:
    """A command channel that delivers given datagrams at given times, and stores the replies to them."""

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
    """Run a simulation that receives command datagrams at given mission times (s)."""
    channel = Script()

    def prepare(rigged: Rigged) -> None:
        commanding = rigged.loop._tasks.commanding
        assert commanding is not None
        commanding._channels = (channel,)
        for at, data in script:
            rigged.at(at, partial(channel.say, data))

    # The rate group of commands needs a scheduled command to run; this command is never due.
    far = {"at": 1e6, "mode": "safe"}
    return fly(commanded(4.0, far), folder, prepare), channel
