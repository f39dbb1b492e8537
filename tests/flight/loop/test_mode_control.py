"""Tests that SAFE detumbles and then acquires the Sun, and that a lost attitude ends pointing."""

from __future__ import annotations

from typing import Any, cast

import pytest

from flight.link import events
from flight.link.events import Mode
from flight.loop import facts
from flight.loop.modes import AttitudeWatch, Trigger
from flight.schema.document import ConfigError
from flight.schema.sections import Detumble, Modes
from hal.interfaces.wires import SECOND_NS
from tests.flight.loop.mode_bench import SATELLITE, TESTBED, ModeBench

FAST, LOW, LOW_FOR = 0.02, 0.008, 3.0


class Watched:
    """The mode control, run once a second, with records of its actions."""

    def __init__(self) -> None:
        modes = Modes(tumble_rate=FAST, known_for=2.0, lost_for=4.0, acquired="point")
        self.watch = AttitudeWatch(modes, Detumble(low_rate=LOW, low_for=LOW_FOR))
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


def test_one_fast_sample_does_not_start_detumbling(watched: Watched) -> None:
    watched.safe(0.5 * FAST, 3)
    watched.safe(20.0 * FAST, 1)
    watched.safe(0.5 * FAST, 3)
    assert "brake" not in watched.began


def test_a_latched_fault_prevents_and_ends_detumbling_and_sun_acquisition_in_safe(watched: Watched) -> None:
    watched.safe(1.5 * FAST, 5, barred=True)
    assert not watched.began
    watched.safe(1.5 * FAST, 5)
    begun = watched.watch.detumbles
    watched.safe(1.5 * FAST, 1, barred=True)
    assert (begun, watched.watch.detumbles, watched.watch.acquires_sun) == (True, False, False)


def test_an_attitude_that_is_lost_for_long_enough_ends_pointing(watched: Watched) -> None:
    watch = watched.watch
    for second in range(20):
        known = second < 5 or second == 7  # a second with a known attitude restarts the timeout
        trigger = watch.trigger(Mode.POINT, known, second * SECOND_NS)
        assert (trigger is Trigger.LOST) is (second >= 12), second
    assert watch.trigger(Mode.ACQUIRE, False, 30 * SECOND_NS) is None


def test_the_flight_starts_in_its_initial_mode_when_readings_and_coils_are_there() -> None:
    bench = ModeBench(settings=Modes(initial="hold", boot_patience=5.0))
    assert bench.step(answers=False) is Mode.BOOT
    assert bench.step(known=False) is Mode.BOOT
    assert bench.events == []
    assert bench.step() is Mode.HOLD
    assert bench.control.since_ns == 3 * SECOND_NS
    assert [(row["before"], row["mode"], row["trigger"]) for row in bench.records] == [
        (0, 0, "begin"),
        (0, 3, "start in hold"),
    ]
    assert bench.events == [], "the end of the boot is not reported as an event"


def test_a_boot_without_readings_is_reported_after_its_timeout() -> None:
    bench = ModeBench(settings=Modes(initial="hold", boot_patience=5.0))
    for _ in range(5):
        bench.step(known=False)
    assert bench.events == []
    bench.step(known=False)
    assert bench.events == ["boot-waits"]


@pytest.mark.parametrize(("unclean", "mode"), [(2, Mode.HOLD), (3, Mode.SAFE)])
def test_after_three_unclean_shutdowns_the_flight_starts_in_safe(unclean: int, mode: Mode) -> None:
    bench = ModeBench(settings=Modes(initial="hold", crash_limit=3), unclean=unclean)
    assert bench.step() is mode
    assert bench.events == (["crashed-often"] if unclean >= 3 else [])


@pytest.mark.parametrize(("unclean", "flies"), [(0, True), (3, False)])
def test_the_configured_steps_are_flown_in_the_demonstration_and_while_booting_into_it(
    unclean: int, flies: bool
) -> None:
    bench = ModeBench(unclean=unclean)
    assert bench.control.flies_steps is flies
    bench.step()
    assert bench.control.flies_steps is flies
    configured = bench.control.target(0)
    assert (configured is not None) is flies


def test_a_body_without_the_initial_mode_is_refused() -> None:
    with pytest.raises(ConfigError, match="this body has detumble, safe"):
        ModeBench(SATELLITE, Modes(initial="hold"))


def flying(initial: str = "hold", **changes: Any) -> ModeBench:
    """Return the mode control of a testbed in its first mode."""
    bench = ModeBench(settings=Modes(initial=cast(Any, initial), **changes))
    bench.step()
    return bench


def test_a_hold_takes_its_attitude_from_the_first_estimate() -> None:
    bench = flying()
    bench.step(known=False)
    bench.step()
    bench.step()
    wanted = bench.control.wanted
    assert wanted is not None
    assert wanted.law.text == "here at 1000000000"
    assert bench.control.target(0) is wanted


@pytest.mark.parametrize("modes", [TESTBED, SATELLITE], ids=["testbed", "satellite"])
@pytest.mark.parametrize("recovers", [False, True])
def test_coils_that_rest_because_the_estimate_is_inaccurate_end_in_safe(
    modes: frozenset[Mode], recovers: bool
) -> None:
    bench = ModeBench(modes, Modes(initial="detumble", blind_limit=20.0, known_for=1.0))
    command = Mode.POINT if modes is SATELLITE else Mode.HOLD
    bench.step(rate=0.5)
    for _ in range(10):
        bench.step()
    assert bench.mode() is command
    for second in range(30):
        bench.step(accurate=recovers and second == 15)
    assert bench.mode() is (command if recovers else Mode.SAFE)
    said = [text for name, text in zip(bench.events, bench.texts, strict=True) if name == "blind"]
    assert said == ([] if recovers else ["no estimate accurate enough for control for 21 s"])


def test_a_satellite_that_acquires_its_attitude_waits_for_an_accurate_estimate() -> None:
    bench = ModeBench(SATELLITE, Modes(initial="detumble", blind_limit=5.0, acquired="acquire"))
    for _ in range(20):
        bench.step(accurate=False)
    assert bench.mode() is Mode.ACQUIRE
    for _ in range(7):
        bench.step(rate=None)
    assert bench.mode() is Mode.SAFE
    assert bench.texts[-2] == "no body rate for 6 s"


def test_a_hold_with_a_large_error_is_impossible_after_its_timeout() -> None:
    bench = flying(hold_error=0.5, hold_patience=3.0)
    bench.targets.off = 0.5
    for _ in range(10):
        assert bench.step() is Mode.HOLD
    bench.targets.off = 0.51
    for _ in range(3):
        assert bench.step() is Mode.HOLD
    bench.step()
    assert bench.mode() is Mode.SAFE
    assert bench.events == ["hold-impossible", "mode"]
    assert bench.texts[1] == "hold -> safe, reaction safe: hold-impossible"
    assert "zero" in bench.asked


def test_in_the_demonstration_only_an_overdue_attitude_counts_as_an_error() -> None:
    bench = flying("testbed-demo", hold_patience=1.0)
    bench.targets.off = 3.0
    for _ in range(5):
        assert bench.step() is Mode.TESTBED_DEMO
    for _ in range(3):
        bench.step(overdue=0.6)
    assert bench.mode() is Mode.SAFE


def test_a_fast_body_is_detumbled_after_8_cycles() -> None:
    bench = flying(tumble_rate=0.5)
    bench.targets.rate = 0.5
    for _ in range(10):
        assert bench.step() is Mode.HOLD
    bench.targets.rate = 0.51
    for _ in range(7):
        assert bench.step() is Mode.HOLD
    bench.step()
    assert bench.mode() is Mode.DETUMBLE
    assert bench.control.detumbles
    assert bench.asked.count("detumble") == 1


def test_detumbling_ends_when_the_rate_was_low_for_its_time_at_an_attitude_that_can_be_held() -> None:
    bench = flying("detumble")
    bench.targets.holdable = False
    for _ in range(4):
        assert bench.step(rate=0.009) is Mode.DETUMBLE
    bench.targets.holdable = True
    for rate in (0.01, 0.009, 0.009):
        assert bench.step(rate=rate) is Mode.DETUMBLE
    assert bench.step(rate=0.009) is Mode.HOLD
    assert bench.asked.count("release") == 1, "the old path is released"


def test_a_slew_arrives_when_angle_and_rate_were_small_for_their_time() -> None:
    bench = flying(arrived_angle=0.02, arrived_rate=0.03, arrived_for=2.0)
    assert bench.control.command(Mode.SLEW, bench.now_ns, 0.2) == ""
    assert bench.mode() is Mode.SLEW
    wanted = bench.control.wanted
    assert wanted is not None
    assert wanted.law.text == "0.2 as number 1"
    for bench.targets.off, bench.targets.rate in ((0.02, 0.0), (0.0, 0.03), (0.019, 0.029), (0.019, 0.029)):
        assert bench.step() is Mode.SLEW
    assert bench.step() is Mode.HOLD
    assert bench.control.wanted is wanted, "the attitude of the slew is held"
    assert bench.texts[-1].startswith("slew -> hold, arrived: 0.0190 rad from the target")


def test_a_slew_is_late_after_its_limit_and_becomes_a_hold() -> None:
    bench = flying(slew_limit=3.0)
    bench.targets.off = 0.1
    bench.control.command(Mode.SLEW, bench.now_ns, 0.2)
    for _ in range(3):
        assert bench.step() is Mode.SLEW
    bench.step()
    assert bench.mode() is Mode.HOLD
    assert "slew-late" in bench.events


def test_without_an_estimate_for_too_long_the_mode_is_safe() -> None:
    bench = flying(blind_limit=3.0)
    for _ in range(3):
        assert bench.step(known=False) is Mode.HOLD
    bench.step(known=False)
    assert bench.mode() is Mode.SAFE
    assert bench.events[0] == "blind"


def test_commands_are_refused_with_a_reason() -> None:
    bench = ModeBench(settings=Modes(initial="hold"))
    command = bench.control.command
    assert command(Mode.HOLD, 0) == "not while in boot"
    assert command(Mode.BOOT, 0) == "boot cannot be commanded"
    known = "safe, detumble, hold, testbed-demo"
    assert command(Mode.SUN, 0) == f"sun cannot be commanded of this body: use {known}"
    bench.step()
    assert command(Mode.SLEW, bench.now_ns, cast(Any, "far")) == "too far"
    assert bench.mode() is Mode.HOLD
    command(Mode.SLEW, bench.now_ns, 0.1)
    wanted = bench.control.wanted
    assert wanted is not None
    assert wanted.law.text == "0.1 as number 1", "a refused command is not counted"
    assert command(Mode.SAFE, bench.now_ns) == ""
    assert command(Mode.SAFE, bench.now_ns) == ""
    assert bench.events.count("mode") == 2, "a command for the present mode changes nothing"


def test_a_latched_fault_bars_the_way_out_of_safe_until_it_is_cleared() -> None:
    bench = flying()
    for _ in range(2):
        bench.facts.update(facts.TOO_HOT, True, bench.now_ns, "hot")
    assert bench.mode() is Mode.SAFE
    assert bench.control.command(Mode.HOLD, bench.now_ns) == "refused until cleared: too-hot"
    bench.facts.clear("too-hot")
    assert bench.control.command(Mode.HOLD, bench.now_ns) == ""
    assert bench.mode() is Mode.HOLD


def test_reactions_without_a_mode_act_on_the_coils_or_stop_the_flight() -> None:
    bench = flying()
    bench.control.react(events.COIL_BROKEN, 0, "x")
    bench.control.react(events.COIL_FAULT, 0, "x")
    bench.control.react(events.CYCLE_SLIP, 0, "x")
    assert bench.asked == ["isolate", "zero"]
    assert bench.control.restart == ""
    bench.control.react(events.MEMORY_HIGH, 0, "2 GB")
    assert bench.asked[2:] == ["stop"]
    assert bench.control.restart == "memory-high: 2 GB"
    assert bench.mode() is Mode.HOLD


def test_new_limits_apply_to_all_conditions() -> None:
    bench = flying()
    bench.control.adopt(
        Modes(initial="hold", arrived_for=0.5, hold_error=0.1, hold_patience=1.0, tumble_rate=0.2)
    )
    bench.targets.off = 0.11
    bench.step()
    assert bench.mode() is Mode.HOLD
    bench.step()
    assert bench.mode() is Mode.SAFE


def orbiting(**changes: Any) -> ModeBench:
    """Return the mode control of a satellite in the mode SAFE."""
    bench = ModeBench(
        SATELLITE, Modes(initial="safe", tumble_rate=FAST, known_for=2.0, lost_for=4.0, **changes)
    )
    bench.step(known=False)
    return bench


def test_a_satellite_boots_with_a_rate_alone_and_seeks_the_sun_in_safe() -> None:
    bench = orbiting()
    assert bench.mode() is Mode.SAFE
    assert bench.asked == ["zero", "sun"]
    assert bench.control.acquires_sun
    assert bench.control.target(0) is None


@pytest.mark.parametrize(("mode", "text"), [(Mode.SUN, "sun"), (Mode.POINT, None)])
def test_a_command_to_point_leads_through_the_acquisition(mode: Mode, text: str | None) -> None:
    bench = orbiting()
    assert bench.control.command(mode, bench.now_ns) == ""
    assert bench.mode() is Mode.ACQUIRE
    for _ in range(2):
        assert bench.step() is Mode.ACQUIRE
    assert bench.step() is mode
    assert (bench.control.wanted is None) is (mode is Mode.POINT)
    found = bench.control.target(0)
    assert found is not None
    assert (found.law.text == "configured") is (mode is Mode.POINT)
    for _ in range(4):
        assert bench.step(known=False) is mode
    assert bench.step(known=False) is Mode.ACQUIRE


def test_a_commanded_target_is_pointed_to_and_kept_through_an_acquisition() -> None:
    bench = orbiting()
    bench.control.command(Mode.POINT, bench.now_ns, cast(Any, "nadir"))
    for _ in range(3):
        bench.step()
    found = bench.control.target(0)
    assert found is not None
    assert found.law.text == "nadir as number 1"
    for _ in range(5):
        bench.step(known=False)
    for _ in range(3):
        bench.step()
    assert bench.control.target(0) is found
    bench.control.command(Mode.POINT, bench.now_ns)
    configured = bench.control.target(0)
    assert configured is not None
    assert configured.law.text == "configured"


def test_a_satellite_that_is_slow_acquires_its_attitude_after_detumbling() -> None:
    bench = orbiting()
    bench.control.command(Mode.DETUMBLE, bench.now_ns)
    for rate in (0.02, 0.009, 0.009):
        assert bench.step(known=False, rate=rate) is Mode.DETUMBLE
    assert bench.step(known=False, rate=0.009) is Mode.ACQUIRE


def test_a_satellite_that_tumbles_while_it_acquires_is_detumbled() -> None:
    bench = orbiting()
    bench.control.command(Mode.POINT, bench.now_ns)
    for _ in range(7):
        assert bench.step(known=False, rate=1.01 * FAST) is Mode.ACQUIRE
    bench.step(known=False, rate=1.01 * FAST)
    assert bench.mode() is Mode.DETUMBLE


@pytest.mark.parametrize(
    ("modes", "initial", "mode", "after"),
    [
        (SATELLITE, "detumble", Mode.DETUMBLE, Mode.ACQUIRE),
        (TESTBED, "testbed-demo", Mode.TESTBED_DEMO, Mode.TESTBED_DEMO),
        (TESTBED, "hold", Mode.HOLD, Mode.HOLD),
    ],
)
def test_a_charged_battery_ends_only_a_safe_mode_that_the_battery_caused(
    modes: frozenset[Mode], initial: Any, mode: Mode, after: Mode
) -> None:
    bench = ModeBench(modes, Modes(initial=initial))
    assert bench.step() is mode

    def battery(critical: bool) -> Mode:
        for _ in range(3):
            bench.facts.update(facts.BATTERY_CRITICAL, critical, bench.now_ns, "charge")
        return bench.mode()

    assert battery(True) is Mode.SAFE
    assert bench.records[-1]["reason"] == "battery-critical"
    assert battery(False) is after
    assert battery(True) is Mode.SAFE
    bench.control.command(Mode.SAFE, bench.now_ns)
    assert battery(False) is Mode.SAFE, "the operator wants safe"
    assert battery(True) is battery(False) is Mode.SAFE, "the mode was safe before"


def test_a_charged_battery_does_not_end_a_safe_mode_with_another_latched_fault() -> None:
    bench = ModeBench(SATELLITE, Modes(initial="detumble"))
    bench.step()
    for critical in (True, False):
        for _ in range(3):
            bench.facts.update(facts.BATTERY_CRITICAL, critical, bench.now_ns, "charge")
            bench.facts.update(facts.TOO_HOT, True, bench.now_ns, "99 degrees")
    assert bench.mode() is Mode.SAFE


@pytest.mark.parametrize("modes", [TESTBED, SATELLITE])
def test_a_flight_that_is_to_begin_in_safe_stays_there_when_the_battery_is_charged(
    modes: frozenset[Mode],
) -> None:
    bench = ModeBench(modes, Modes(initial="safe"))
    assert bench.step(answers=False) is Mode.BOOT
    for critical in (True, False):
        for _ in range(3):
            bench.facts.update(facts.BATTERY_CRITICAL, critical, bench.now_ns, "charge")
        assert bench.mode() is Mode.SAFE
