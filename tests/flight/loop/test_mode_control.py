"""SAFE brakes a spin and then seeks the Sun, never while barred; a lost attitude ends pointing."""

from __future__ import annotations

import pytest

from flight.link.modes import Mode
from flight.loop.modes import AttitudeWatch, Trigger
from flight.schema.sections import Modes
from hal.interfaces.wires import SECOND_NS

FAST, LOW, LOW_FOR = 0.02, 0.008, 3.0


class Watched:
    """The watch with what it began, a step each second."""

    def __init__(self) -> None:
        self.watch = AttitudeWatch(
            Modes(tumble_rate=FAST, known_for=2.0, lost_for=4.0, acquired="point"), LOW, LOW_FOR
        )
        self.began: list[str] = []
        self.now_ns = 0

    def safe(self, rate: float, seconds: int, barred: bool = False) -> None:
        for _ in range(seconds):
            self.now_ns += SECOND_NS
            self.watch.watch_safe(
                rate,
                barred,
                lambda _: self.began.append("brake"),
                lambda _: self.began.append("seek"),
                self.now_ns,
            )


@pytest.fixture
def watched() -> Watched:
    return Watched()


def test_a_slow_body_in_safe_seeks_the_sun_at_once(watched: Watched) -> None:
    watched.safe(0.5 * FAST, 1)
    assert watched.began == ["seek"]
    assert watched.watch.acquires_sun
    assert not watched.watch.detumbles


def test_a_spin_in_safe_is_braked_until_it_has_been_slow_and_then_the_sun_is_sought(watched: Watched) -> None:
    watched.safe(1.5 * FAST, 5)
    assert watched.began == ["seek", "brake"]
    assert watched.watch.detumbles
    assert not watched.watch.acquires_sun
    watched.safe(0.5 * LOW, 1)
    assert watched.watch.detumbles, "not slow for long enough"
    watched.safe(0.5 * LOW, 5)
    assert watched.began == ["seek", "brake", "seek"]
    assert watched.watch.acquires_sun


def test_one_fast_sample_brakes_nothing(watched: Watched) -> None:
    watched.safe(0.5 * FAST, 3)
    watched.safe(20.0 * FAST, 1)
    watched.safe(0.5 * FAST, 3)
    assert "brake" not in watched.began


def test_a_latched_fault_bars_both_also_what_has_begun(watched: Watched) -> None:
    watched.safe(1.5 * FAST, 5, barred=True)
    assert not watched.began
    watched.safe(1.5 * FAST, 5)
    begun = watched.watch.detumbles
    watched.safe(1.5 * FAST, 1, barred=True)
    assert (begun, watched.watch.detumbles, watched.watch.acquires_sun) == (True, False, False)


def test_an_attitude_that_is_lost_for_long_enough_ends_pointing(watched: Watched) -> None:
    watch = watched.watch
    for second in range(20):
        known = second < 5 or second == 7  # known again for an instant, which restarts the timeout
        trigger = watch.trigger(Mode.POINT, known, second * SECOND_NS)
        assert (trigger is Trigger.LOST) is (second >= 12), second
    assert watch.trigger(Mode.ACQUIRE, False, 30 * SECOND_NS) is None
