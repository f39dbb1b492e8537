"""Tests that the guardian and the service manager receive the heartbeats of the loop."""

from __future__ import annotations

import pytest

from flight.app.service import Supervision
from flight.link.events import EventKind
from flight.link.telemetry.log import Recorder
from hal.interfaces.guardian import GuardianNews
from tests.manual_clock import ManualClock


class Watchers:
    """Test double of guardian and service manager that records the calls."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.news: list[GuardianNews] = []

    def beat(self) -> None:
        self.calls.append("beat")

    def tend(self, _: int) -> list[GuardianNews]:
        news, self.news = self.news, []
        return news

    def ready(self, status: str) -> None:
        self.calls.append(f"ready: {status}")

    def feed_watchdog(self) -> None:
        self.calls.append("feed")


class Events(Recorder):
    """Event sink that keeps the events in a list."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, str]] = []

    def event(self, kind: EventKind, time_ns: int, suppressed: int, text: str) -> None:
        self.calls.append((kind.name, text))


class CoilJob:
    """Coil task that fails while `broken` is set."""

    def __init__(self, clock: ManualClock) -> None:
        self.broken = False
        self.ticker = clock.ticker("coils", 50_000_000, self._serve)

    def _serve(self) -> None:
        if self.broken:
            raise MemoryError


@pytest.fixture
def watchers() -> Watchers:
    return Watchers()


@pytest.fixture
def events() -> Events:
    return Events()


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def coils(clock: ManualClock) -> CoilJob:
    return CoilJob(clock)


@pytest.fixture
def supervision(watchers: Watchers, events: Events, clock: ManualClock, coils: CoilJob) -> Supervision:
    return Supervision(watchers, watchers, clock, events, "flying", coils.ticker)


def test_ready_is_reported_once_after_the_first_completed_cycle(
    supervision: Supervision, watchers: Watchers
) -> None:
    supervision.feed()
    assert watchers.calls == ["feed"], "progress without a good cycle is not reported as readiness"
    supervision.beat()
    supervision.beat()
    assert watchers.calls == ["feed", "beat", "ready: flying", "beat"]


def test_changes_of_the_guardian_are_reported_as_events(
    supervision: Supervision, watchers: Watchers, events: Events
) -> None:
    watchers.news = list(GuardianNews)
    supervision.feed()
    supervision.feed()
    assert events.calls == [
        ("guardian-lost", GuardianNews.LOST.value),
        ("guardian-ready", GuardianNews.READY.value),
        ("guardian-acted", GuardianNews.ACTED.value),
        ("guardian-blind", GuardianNews.FAILED.value),
    ]


def test_a_guardian_that_acts_again_and_again_is_reported_once_in_a_while(
    supervision: Supervision, watchers: Watchers, events: Events, clock: ManualClock
) -> None:
    for _ in range(40):
        watchers.news = [GuardianNews.ACTED]
        supervision.feed()
        clock.advance(250_000_000)
    assert events.calls == [("guardian-acted", GuardianNews.ACTED.value)] * 10, "ten seconds, one in each"


def test_a_loop_whose_commands_do_not_reach_the_coils_sends_no_heartbeat(
    supervision: Supervision, watchers: Watchers, clock: ManualClock, coils: CoilJob
) -> None:
    for _ in range(4):
        clock.advance(25_000_000)
        supervision.beat()
    assert watchers.calls.count("beat") == 4
    coils.broken = True
    clock.advance(200_000_000)
    supervision.beat()
    assert watchers.calls.count("beat") == 4
    coils.broken = False
    clock.advance(50_000_000)
    supervision.beat()
    assert watchers.calls.count("beat") == 5


def test_the_process_settles_once_before_it_is_called_ready(
    watchers: Watchers, events: Events, clock: ManualClock, coils: CoilJob
) -> None:
    calls = watchers.calls
    settling = Supervision(
        watchers, watchers, clock, events, "flying", coils.ticker, lambda: calls.append("settled")
    )
    settling.beat()
    settling.beat()
    assert calls == ["beat", "settled", "ready: flying", "beat"]
