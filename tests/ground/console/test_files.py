"""Tests that the console lists, downloads and uploads files of the satellite over a link."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ground.console.commanding import LinkFeed, LinkFiles, RunFiles
from knightcube.errors import FlightError, UsageError
from tests.flight.link.process.filed_ends import FiledEnds


class Ends(FiledEnds):
    """Both ends of a link. At the ground end, the console is the only program."""

    def collect(self) -> None:
        """Leave received telemetry to the console."""
        self.packets += list(self.terminal.take())


@pytest.fixture
def console(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Ends, LinkFeed, LinkFiles]]:
    ends = Ends(tmp_path)

    def packets(_: float) -> list[tuple[int, bytes]]:
        before = len(ends.packets)
        ends.turn(0.5)
        return ends.packets[before:]

    monkeypatch.setattr(ends.terminal, "packets", packets)
    feed = LinkFeed(ends.terminal)
    yield ends, feed, LinkFiles(feed, tmp_path / "console")
    ends.close()


def during(feed: LinkFeed, request: Callable[[], Any]) -> Any:
    """Run a request while the feed is read; return the result of the request, or its FlightError."""
    found: list[Any] = []

    def work() -> None:
        try:
            found.append(request())
        except FlightError as error:
            found.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    for _ in range(2000):
        feed.new()
        thread.join(0.005)
        if not thread.is_alive():
            break
    (result,) = found
    return result


def test_a_file_goes_up_stands_in_the_list_and_comes_down_again(
    console: tuple[Ends, LinkFeed, LinkFiles],
) -> None:
    _, feed, files = console
    data = bytes(range(256)) * 20
    put = during(feed, lambda: files.put("elements", "tle.txt", data))
    name = "received/elements/tle.txt"
    assert put == {"name": name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    listed = during(feed, files.listing)["files"]
    assert (name, len(data)) in {(file["name"], file["bytes"]) for file in listed}
    assert during(feed, lambda: files.get(name)).read_bytes() == data
    assert "no such" in str(during(feed, lambda: files.get("received/elements/other.txt"))).lower()


@pytest.mark.parametrize("name", ["../key", "/etc/passwd", "a b", ""])
def test_a_name_that_leaves_the_folder_is_refused(
    console: tuple[Ends, LinkFeed, LinkFiles], name: str, tmp_path: Path
) -> None:
    _, _, files = console
    with pytest.raises(UsageError):
        files.get(name)
    with pytest.raises(UsageError):
        files.put("elements", name, b"")
    with pytest.raises(UsageError):
        RunFiles(tmp_path).get(name)
    with pytest.raises(UsageError, match="kind"):
        files.put("keys", "tle.txt", b"")
