"""Tests of parts of the flight service with test doubles: signals, releases, memory and supervision."""

from __future__ import annotations

import gc
import json
import signal
import threading
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from flight.app import service
from flight.app.service import Collector, EndingSignals, FlownRelease, Supervision
from flight.link import events
from flight.link.files.store import line_of, to_record
from flight.loop.state import LinuxFiles
from flight.schema.document import ConfigError
from hal.interfaces.guardian import GuardianNews

MS = 1_000_000


def loop(said: list[str]) -> Any:
    """Return a test double of the loop that stores the reasons of the calls that stop it."""
    return cast(Any, SimpleNamespace(stop=said.append))


def test_a_signal_stops_the_flight_at_once_or_when_it_begins() -> None:
    said: list[str] = []
    before = signal.getsignal(signal.SIGTERM)
    with EndingSignals() as signals:
        received = [signals.received]
        signal.raise_signal(signal.SIGTERM)
        assert [*received, signals.received] == [False, True]
        signals.end(loop(said))
        assert said == ["stopped by SIGTERM"]
        signal.raise_signal(signal.SIGINT)
        assert said == ["stopped by SIGTERM", "stopped by SIGINT"]
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_second_signal_interrupts_the_opening() -> None:
    with EndingSignals():
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)


def test_an_ignored_hangup_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with EndingSignals() as signals:
            signal.raise_signal(signal.SIGHUP)
            assert not signals.received
            assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        with EndingSignals() as signals:
            signal.raise_signal(signal.SIGHUP)
            assert signals.received
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_flight_in_another_thread_leaves_the_signals_alone() -> None:
    before, found = signal.getsignal(signal.SIGTERM), []

    def run() -> None:
        with EndingSignals() as signals:
            found.append((signal.getsignal(signal.SIGTERM), signals.received))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [(before, False)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the state folder of the service."""
    monkeypatch.setattr(service, "service_folder", lambda _: tmp_path)
    return tmp_path


def kept(folder: Path) -> Any:
    """Return the record of releases."""
    line = line_of((folder / "releases.json").read_bytes())
    assert line is not None
    return json.loads(line)


def keep(folder: Path, facts: Any) -> None:
    """Write a record of releases."""
    (folder / "releases.json").write_bytes(to_record(json.dumps(facts).encode()))


def test_a_release_is_proven_once_and_the_newest_four_are_kept(folder: Path) -> None:
    keep(folder, {"starts": {"e": 2}, "proven": ["a", "b", "e", "c", "d"]})
    release = FlownRelease({"KNIGHTCUBE_RELEASE": "e", "KNIGHTCUBE_RELEASE_NOTE": "note"})
    assert release.note == "note"
    release.prove()
    assert kept(folder) == {"starts": {}, "proven": ["b", "c", "d", "e"]}
    (folder / "releases.json").unlink()
    release.prove()
    assert not (folder / "releases.json").exists(), "it is recorded once"
    release.end()
    assert kept(folder) == {"starts": {}, "proven": []}


def test_the_end_of_a_release_resets_the_count_of_its_starts(folder: Path) -> None:
    keep(folder, {"starts": {"e": 2}, "proven": ["a"]})
    FlownRelease({"KNIGHTCUBE_RELEASE": "e"}).end()
    assert kept(folder) == {"starts": {}, "proven": ["a"]}
    (folder / "releases.json").write_text("{damaged")
    FlownRelease({"KNIGHTCUBE_RELEASE": "e"}).end()
    assert kept(folder) == {"starts": {}, "proven": []}


def test_a_flight_without_a_named_release_writes_nothing(folder: Path) -> None:
    release, tickers = FlownRelease({}), []
    clock = SimpleNamespace(ticker=lambda *arguments: tickers.append(arguments))
    with ExitStack() as stack:
        release.serve(cast(Any, clock), stack)
    release.prove()
    release.end()
    assert (tickers, list(folder.iterdir()), release.note) == ([], [], "")


def test_a_named_release_is_proven_after_a_minute_until_the_flight_ends(folder: Path) -> None:
    stopped: list[bool] = []
    made: list[tuple[Any, ...]] = []

    def ticker(*arguments: Any) -> Any:
        made.append(arguments)
        return SimpleNamespace(stop=lambda: stopped.append(True))

    release = FlownRelease({"KNIGHTCUBE_RELEASE": "e"})
    with ExitStack() as stack:
        release.serve(cast(Any, SimpleNamespace(ticker=ticker)), stack)
        assert stopped == []
        assert made == [("release", 60_000_000_000, release.prove)]
    assert stopped == [True]


def test_garbage_is_collected_from_the_second_call_on(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    monkeypatch.setattr(gc, "collect", lambda: done.append("collect"))
    monkeypatch.setattr(gc, "freeze", lambda: done.append("freeze"))
    collector = Collector()
    collector()
    assert done == ["freeze"]
    collector()
    assert done == ["freeze", "collect", "freeze"]


class Bench:
    """The supervision of a flight, with test doubles of the guardian and the service manager."""

    def __init__(self) -> None:
        self.now = 1_000 * MS
        self.done: list[str] = []
        self.recorded: list[Any] = []
        self.news: list[GuardianNews] = []
        self.coils = SimpleNamespace(served_ns=0)
        guardian = SimpleNamespace(beat=lambda: self.done.append("beat"), tend=self._tend)
        overseer = SimpleNamespace(
            ready=lambda status: self.done.append(f"ready {status}"),
            feed_watchdog=lambda: self.done.append("fed"),
        )
        clock = SimpleNamespace(now_ns=lambda: self.now)
        recorder = SimpleNamespace(event=lambda *event: self.recorded.append(event))
        parts: Any = (guardian, overseer, clock, recorder, "flying", self.coils)
        self.supervision = cast(Any, Supervision)(*parts, lambda: self.done.append("settled"))

    def _tend(self, now: int) -> list[GuardianNews]:
        assert now == self.now
        news, self.news = self.news, []
        return news

    def kinds(self) -> list[str]:
        """Return the names of the recorded events."""
        return [str(event) for event in self.recorded]


def test_heartbeats_pass_while_the_job_of_the_coils_is_served() -> None:
    bench = Bench()
    bench.coils.served_ns = bench.now - 150 * MS - 1
    bench.supervision.beat()
    assert bench.done == [], "the job is stalled"
    bench.coils.served_ns = bench.now - 150 * MS
    bench.supervision.beat()
    assert bench.done == ["beat", "settled", "ready flying"]
    bench.supervision.beat()
    assert bench.done == ["beat", "settled", "ready flying", "beat"], "ready once"


def test_a_coil_driver_without_a_periodic_job_is_refused() -> None:
    clock = SimpleNamespace(tickers=[SimpleNamespace(name="imu")])
    with (
        ExitStack() as stack,
        pytest.raises(ConfigError, match=r"coils\.driver: has started no ticker 'coils'"),
    ):
        service.supervise(cast(Any, None), cast(Any, clock), cast(Any, None), stack)


def test_the_guardians_news_and_notes_of_the_start_become_events() -> None:
    bench = Bench()
    bench.supervision.note(events.REAL_TIME, "priority 50")
    bench.news = [GuardianNews.LOST, GuardianNews.READY]
    bench.supervision.feed()
    assert bench.done == ["fed"]
    assert len(bench.recorded) == 3
    for text, name in zip(bench.kinds(), ("real-time", "guardian-lost", "guardian-ready"), strict=True):
        assert name in text
    bench.supervision.feed()
    assert len(bench.recorded) == 3, "each note is reported once"
    bench.supervision.close()


def test_a_record_that_cannot_be_read_once_keeps_its_proven_releases(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = {"starts": {"e": 2}, "proven": ["a", "b"]}
    keep(folder, record)
    release = FlownRelease({"KNIGHTCUBE_RELEASE": "e"})

    def fail(*_: object) -> bytes:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(LinuxFiles, "read", fail)
        release.prove()
        release.end()
    assert kept(folder) == record
    release.prove()
    assert kept(folder) == {"starts": {}, "proven": ["a", "b", "e"]}
