"""The loop's signs of life, passed on to guardian and service manager."""

from __future__ import annotations

import pytest

from flight.events import EventKind
from flight.supervision import Supervision
from flight.telemetry.recorder import Recorder
from hal.interfaces.guardian import GuardianNews
from tests.manual_clock import ManualClock


class Watchers:
    """Guardian and service manager in one; note what they are told."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.news: list[GuardianNews] = []

    def beat(self) -> None:
        self.told.append("beat")

    def tend(self, _: int) -> list[GuardianNews]:
        news, self.news = self.news, []
        return news

    def ready(self, status: str) -> None:
        self.told.append(f"ready: {status}")

    def feed_watchdog(self) -> None:
        self.told.append("feed")


class Events(Recorder):
    """Keeps the events in place of writing them."""

    def __init__(self) -> None:
        self.told: list[tuple[str, str]] = []

    def event(self, kind: EventKind, time_ns: int, suppressed: int, text: str) -> None:
        self.told.append((kind.name, text))


@pytest.fixture
def watchers() -> Watchers:
    return Watchers()


@pytest.fixture
def events() -> Events:
    return Events()


@pytest.fixture
def supervision(watchers: Watchers, events: Events) -> Supervision:
    return Supervision(watchers, watchers, ManualClock(), events, "flying")


def test_ready_is_said_once_after_the_first_good_cycle(supervision: Supervision, watchers: Watchers) -> None:
    supervision.feed()
    assert watchers.told == ["feed"], "progress alone is no readiness"
    supervision.beat()
    supervision.beat()
    assert watchers.told == ["feed", "beat", "ready: flying", "beat"]


def test_what_becomes_of_the_guardian_is_told_as_events(
    supervision: Supervision, watchers: Watchers, events: Events
) -> None:
    watchers.news = list(GuardianNews)
    supervision.feed()
    supervision.feed()
    assert events.told == [
        ("guardian-lost", GuardianNews.LOST.value),
        ("guardian-ready", GuardianNews.READY.value),
        ("guardian-acted", GuardianNews.ACTED.value),
        ("guardian-blind", GuardianNews.FAILED.value),
    ]
