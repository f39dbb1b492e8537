"""Tests of the console over a link: telemetry, a verified command, a silent link, and files."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from flight.link.commands import ChangeMode, CommandPacker
from flight.link.events import Mode
from flight.link.telemetry.definitions import MODE, RUN, VERIFICATION
from flight.link.telemetry.packets import LAYOUTS
from ground.console import commanding
from ground.console.commanding import CommandForms, LinkFeed, LinkFiles, RunFiles, flying
from ground.console.history import History, PageState
from ground.console.server import Console
from ground.console.surroundings import UNKNOWN
from ground.xtce import TELECOMMANDS
from hal.interfaces.wires import SECOND_NS
from knightcube.errors import KnightCubeError, UsageError
from tests.flight.link.process.both_ends import BothEnds, GroundWire
from tests.flight.link.process.filed_ends import FiledEnds
from tests.support.places import ROOT


class Satellite:
    """Both ends of a link.

    The ground end is a `LinkFeed`. Each update of the feed runs one cycle of the satellite's end.
    """

    def __init__(self, ends: BothEnds, monkeypatch: pytest.MonkeyPatch) -> None:
        self.ends = ends
        # While the terminal waits, the satellite's end of the link runs.
        monkeypatch.setattr(ends.terminal, "packets", self.packets)
        self.feed = LinkFeed(ends.terminal)

    def packets(self, seconds: float) -> list[tuple[int, bytes]]:
        """Run one cycle of the satellite's end, and return the packets that it sent."""
        before = len(self.ends.packets)
        self.ends.turn(0.5)
        return self.ends.packets[before:]


@pytest.fixture
def satellite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Satellite]:
    ends = BothEnds(tmp_path)
    yield Satellite(ends, monkeypatch)
    ends.close()


def test_the_console_requests_telemetry_once_and_returns_what_the_flight_records(
    satellite: Satellite,
) -> None:
    ends, feed = satellite.ends, satellite.feed
    ends.record(ends.mode_packet(Mode.HOLD, "ready"))
    came = [feed.new() for _ in range(4)]
    assert sum(len(packets["mode"]) for packets in came) == 1
    assert sum(len(packets["link"]) for packets in came) >= 1
    assert len(ends.obeyed) == 1, "the ping that asks for telemetry"
    assert feed.silence < 60.0


def test_the_console_sends_a_ping_every_20_s_so_that_the_link_does_not_forget_it(
    satellite: Satellite,
) -> None:
    """Otherwise a UDP line discards the live telemetry of some seconds in each minute."""
    ends, feed = satellite.ends, satellite.feed
    for age, pings in ((0.0, 1), (19.0, 1), (21.0, 2)):
        feed._received = time.monotonic()
        feed._asked -= age
        feed.new()
        assert len(ends.obeyed) == pings


def test_telemetry_arrives_while_the_network_refuses_the_pings(
    satellite: Satellite, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends, feed = satellite.ends, satellite.feed

    def fail(*_: object) -> int:
        raise KnightCubeError("192.0.2.7:5010: cannot be reached: Network is unreachable")

    with monkeypatch.context() as broken:
        broken.setattr(GroundWire, "send", fail)
        ends.record(ends.mode_packet(Mode.HOLD, "ready"))
        assert len(feed.new()["mode"]) == 1
    assert "Network is unreachable" in feed.problem
    assert feed.failing > 0.0
    feed._asked = -1.0
    feed.new()
    assert (feed.problem, feed.failing) == ("", 0.0)


def test_after_a_restart_of_the_flight_the_console_shows_the_new_flight_only(satellite: Satellite) -> None:
    ends, feed = satellite.ends, satellite.feed

    def run(utc_ns: int, time_s: int) -> bytes:
        fields = {field.name: [0.0] * 3 if field.count == 3 else 0 for field in RUN.fields}
        texts = {"config_name": "orbit", "software": "1"}
        return ends.packer.pack(RUN, time_s * SECOND_NS, {**fields, **texts, "utc_ns": utc_ns})

    def mode(time_s: int, trigger: str = "") -> bytes:
        fields = {"before": 0, "mode": int(Mode.HOLD), "trigger": trigger, "reason": "", "target_q2": 0.0}
        return ends.packer.pack(MODE, time_s * SECOND_NS, fields)

    with History() as history:
        console = Console("x", feed, history, UNKNOWN, CommandForms(None))
        page = PageState(history)

        def show() -> dict[str, Any]:
            for _ in range(12):
                console.read()
            return page.at(history.span_ns[1], LAYOUTS)

        ends.record(run(10**18, 0), mode(100), mode(101))
        assert show()["newest"]["mode"]["time_ns"] == 101 * SECOND_NS
        ends.record(run(10**18 + 1, 102), mode(103))  # a correction of UTC
        show()
        ends.record(mode(80))  # sent again because only the link process has restarted
        show()
        assert (history.count("mode", 10**18), feed.restarts, console.trouble) == (4, 0, "")
        ends.record(run(10**18 + 200 * SECOND_NS, 0), mode(1), mode(2, "new"))
        shown = show()
        assert (shown["again"], shown["newest"]["mode"]["trigger"]) == (True, "new")
        times, _ = history.series("mode", "mode", 0, (0, 10**18), 100)
        assert (times.tolist(), feed.restarts) == ([1.0, 2.0], 1)
        assert console.utc_ns == 10**18 + 200 * SECOND_NS, "the link repeats the packet `run`"
        assert "restarts of the flight: 1" in console.trouble


def answered(satellite: Satellite, send: Callable[[], dict[str, object]]) -> dict[str, object]:
    """Send a command in a second thread, as the server of the page does, and return the reply."""
    answers: list[dict[str, object]] = []
    sending = threading.Thread(target=lambda: answers.append(send()))
    sending.start()
    for _ in range(200):
        satellite.feed.new()
        sending.join(0.01)
        if not sending.is_alive():
            break
    (answer,) = answers
    return answer


def test_the_forms_of_a_link_schedule_a_command_and_list_it(satellite: Satellite) -> None:
    forms = CommandForms(satellite.feed.send, TELECOMMANDS)
    given = {"at": "2099-01-01T00:00:00", "words": "slew 0.2"}
    assert forms.text("schedule", given) == "at 2099-01-01T00:00:00: slew to q2 +0.2000"
    assert answered(satellite, lambda: forms.obey("schedule", given))["obeyed"] == 1
    listed = answered(satellite, lambda: forms.obey("list-schedule", {}))
    assert listed["text"] == "1: 2099-01-01T00:00:00Z slew to q2 +0.2000; 1 scheduled"
    with pytest.raises(UsageError, match="new-key: no such command"):
        forms.text("new-key", {})


def test_a_schedule_whose_reports_arrive_one_after_another_is_listed_whole(
    satellite: Satellite, monkeypatch: pytest.MonkeyPatch
) -> None:
    forms = CommandForms(satellite.feed.send, TELECOMMANDS)
    for minute in (1, 2):
        given = {"at": f"2099-01-01T00:0{minute}:00", "words": "slew 0.2"}
        answered(satellite, lambda given=given: forms.obey("schedule", given))  # type: ignore[misc]
    waiting: list[tuple[int, bytes]] = []
    report = LAYOUTS[VERIFICATION.name].identifier.to_bytes(2, "big")

    def up_to_a_report(seconds: float) -> list[tuple[int, bytes]]:
        waiting.extend(satellite.packets(seconds))
        reports = (k for k, (_, packet) in enumerate(waiting) if packet[:2] == report)
        stop = next(reports, len(waiting)) + 1
        found, waiting[:stop] = waiting[:stop], []
        time.sleep(0.05)
        return found

    monkeypatch.setattr(satellite.ends.terminal, "packets", up_to_a_report)
    listed = answered(satellite, lambda: forms.obey("list-schedule", {}))
    entries = [f"{k}: 2099-01-01T00:0{k}:00Z slew to q2 +0.2000" for k in (1, 2)]
    assert listed["text"] == "; ".join([*entries, "2 scheduled"])


def test_a_command_is_answered_with_its_counter_and_what_became_of_it(satellite: Satellite) -> None:
    feed = satellite.feed
    packet = CommandPacker().pack(ChangeMode(Mode.SAFE, "bored"), 7)
    answer = answered(satellite, lambda: feed.send(packet))
    assert packet in satellite.ends.obeyed
    assert answer["obeyed"] == 1
    assert satellite.ends.stages(int(str(answer["counter"])))[0] == "accepted"


def test_a_missing_answer_is_reported_after_its_timeout(
    satellite: Satellite, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commanding, "_ANSWER_S", 0.05)
    with pytest.raises(KnightCubeError, match=r"no answer over the link within 0\.05 s"):
        satellite.feed.send(CommandPacker().pack(ChangeMode(Mode.SAFE), 7))


DEMO = ROOT / "config" / "step_demo.yaml"
WORDY = """
import pathlib, sys
sys.stderr.write("progress\\n" * 40_000)
sys.stderr.flush()
folder = pathlib.Path(sys.argv[1])
folder.mkdir()
(folder / "flight-0001.ccsds").write_bytes(b"")
sys.exit("knightcube: the disk failed")
"""


def test_a_flight_with_long_output_continues_and_its_failure_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pipe that nobody reads blocks a process after 64 KiB."""
    monkeypatch.setattr(commanding, "_START_S", 10.0)
    start, out = subprocess.Popen, tmp_path / "run"

    def stand_in(words: list[str], **streams: Any) -> subprocess.Popen[str]:
        assert words[-2:] == ["--out", str(out)]
        return start([sys.executable, "-c", WORDY, str(out)], **streams)

    monkeypatch.setattr(subprocess, "Popen", stand_in)
    reason = "the flight process ended with exit status 1: knightcube: the disk failed"

    def until_reported() -> str:
        with flying(DEMO, out) as flight:
            until = time.monotonic() + 10.0
            while not flight.trouble() and time.monotonic() < until:
                time.sleep(0.02)
            return flight.trouble()

    with pytest.raises(KnightCubeError, match=reason):
        until_reported()


def test_a_new_flight_is_not_shown_by_an_old_log(tmp_path: Path) -> None:
    (tmp_path / "flight-0001.ccsds").write_bytes(b"")
    with pytest.raises(UsageError, match="already contains a run: give a new folder"), flying(DEMO, tmp_path):
        pass


class Ends(FiledEnds):
    """Both ends of a link. At the ground end, the console is the only program."""

    def collect(self) -> None:
        """Keep the received packets for the console."""
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
    """Run a request in a thread while the feed is read; return its result or its KnightCubeError."""
    found: list[Any] = []

    def work() -> None:
        try:
            found.append(request())
        except KnightCubeError as error:
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


def test_a_file_is_uplinked_listed_and_downlinked_again(
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


def test_a_transfer_ends_with_the_reason_if_the_ground_cannot_send_for_long(
    console: tuple[Ends, LinkFeed, LinkFiles], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, feed, files = console

    def fail(*_: object) -> None:
        raise KnightCubeError("192.0.2.7:5010: cannot be reached: Network is unreachable")

    feed.new()
    monkeypatch.setattr(GroundWire, "send", fail)
    monkeypatch.setattr(commanding, "_SILENCE_S", 0.2)
    monkeypatch.setattr(LinkFeed, "silence", 0.0)
    put = during(feed, lambda: files.put("elements", "tle.txt", b"x" * 5000))
    assert str(put) == (
        "192.0.2.7:5010: cannot be reached: Network is unreachable; the received data is kept"
    )


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
