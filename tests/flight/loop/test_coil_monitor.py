"""Tests that faulty coils are found by supply current and motion, and healthy coils are not suspected."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from flight.loop.coil_currents import (
    ELECTRICAL,
    MEAN,
    NEWEST,
    PLACE,
    Bounds,
    BrakeProof,
    CoilFault,
    Evidence,
    Predicted,
    Sampling,
    StuckLeg,
    Supplied,
    fits,
    is_healthy_current,
    predict,
    supply_currents,
)
from flight.loop.coil_monitor import CoilMonitor, CoilMonitorSettings
from hal.interfaces.devices import NO_AXES, ImuReading, PowerReading
from knightcube.astro.arrays import FloatArray
from tests.sim_hal.faults.coil_bench import Command, hold, observe

TARGET = -0.6
FAULT_AT = 6.0
FULL = 3.4 / 23.0
BOUNDS = Bounds((FULL, FULL, FULL), 3.5e-3, 0.2, 1.5e-3)


@pytest.mark.parametrize(
    ("fault", "names", "within"),
    [
        ("coil-x: open", {"OPEN", "UNCERTAIN"}, 3.5),
        ("coil-x: shorted", {"SHORTED"}, 4.0),
        ("coil-x: shorted (ohm=1)", {"SHORTED"}, 4.0),  # the current exceeds the range of the monitor
        ("bridge-x: a-low", {"A_LOW", "UNCERTAIN"}, 3.5),
        ("bridge-x: a-high", {"HIGH"}, 4.0),
        ("bridge-y: a-high", {"HIGH"}, 3.0),
        ("bridge-z: b-high", {"HIGH"}, 3.5),
    ],
)
def test_a_broken_axis_is_found_and_named(fault: str, names: set[str], within: float) -> None:
    seen = observe(hold(TARGET), FAULT_AT + within + 1.0, [f"{fault} @ {FAULT_AT}"])
    assert len(seen.found) == 1
    (when, axis, name) = seen.found[0]
    assert axis == fault[5 if fault.startswith("coil") else 7]
    assert name in names
    assert FAULT_AT < when < FAULT_AT + within
    assert not seen.watch.available["xyz".index(axis)]


def full(time: float, _: ImuReading) -> FloatArray:
    """Return currents at the limit for all coils, as in a fast tumble. The sign of coil z changes at 4 s."""
    return np.array([FULL, FULL, -FULL if time < 4.0 else FULL])


@pytest.mark.parametrize("axis", range(3))
def test_the_open_coil_of_three_that_are_all_driven_fully_is_found_by_the_probe(axis: int) -> None:
    seen = observe(full, FAULT_AT + 8.0, [f"coil-{'xyz'[axis]}: open @ {FAULT_AT}"], monitor_only=True)
    ((when, found, name),) = seen.found
    assert found == "xyz"[axis]
    assert name in {"OPEN", "UNCERTAIN"}
    assert FAULT_AT < when < FAULT_AT + 7.5
    driven = np.count_nonzero(np.abs(seen.carried[(seen.times > FAULT_AT) & (seen.times < when)]), axis=1)
    assert (driven == 1).any() or axis == 0, "a healthy coil was probed alone before the open coil"


def test_after_a_fault_that_ends_all_coils_are_used_and_not_suspected() -> None:
    seen = observe(full, 16.0, [f"coil-z: open @ {FAULT_AT} for 1.5"], monitor_only=True)
    assert seen.found == []
    assert seen.suspicious > 0
    assert seen.watch.suspicion == ""
    assert seen.watch.probe is None


def pulses(time: float, _: ImuReading) -> FloatArray:
    """Return -60 mA in coil y for 0.8 s, followed by a pause of 2.2 s."""
    return np.array([0.0, -0.06 if time % 3.0 < 0.8 else 0.0, 0.0])


def test_a_leg_that_is_needed_only_in_short_pulses_is_found_by_the_probe_in_a_pause() -> None:
    """A suspicion at the end of a pulse is followed by probes, although the coils are at zero current."""
    seen = observe(pulses, FAULT_AT + 12.0, [f"bridge-y: b-low @ {FAULT_AT}"], monitor_only=True)
    ((when, axis, name),) = seen.found
    assert (axis, name) == ("y", "B_LOW")
    assert FAULT_AT < when < FAULT_AT + 9.0


def test_healthy_coils_in_short_pulses_are_neither_suspected_nor_probed() -> None:
    seen = observe(pulses, 20.0, monitor_only=True)
    assert seen.found == []
    assert seen.suspicious == 0


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_a_wrong_gain_of_the_monitor_in_short_pulses_does_not_isolate_a_coil(gain: float) -> None:
    """A probe that begins at rest is compared with a probe of another coil before a coil is isolated."""
    watch, drawn = CoilMonitor(CoilMonitorSettings((FULL, FULL, FULL))), [0.0]
    for cycle in range(40 * 20):
        time, now_ns = 0.025 * cycle, 25_000_000 * cycle
        if cycle % 8 == 0:
            mean, newest = gain * float(np.mean(drawn[-40:])), gain * drawn[-1]
            watch.measured(PowerReading(now_ns, 5.0, mean, 5.0 * mean, newest, now_ns - 200_000_000))
        wanted = np.array([0.0, -0.06 if time % 3.0 < 0.8 else 0.0, 0.0])
        wanted = wanted if watch.probe is None else watch.probe
        watch.commanded(now_ns, wanted)
        drawn.append(float(np.abs(wanted).sum()))
    assert watch.verdicts == ()
    assert f"the monitor measures {gain:.2f} times the current" in watch.monitor_doubted


def test_a_suspicion_of_coils_at_zero_ends_if_no_probe_is_applied() -> None:
    """A suspicion ends after the time of the probe, even if another mode commands zero current instead."""
    watch = CoilMonitor(CoilMonitorSettings((FULL, FULL, FULL)))
    suspicious = []
    for cycle in range(40 * 6):
        time = 0.025 * cycle
        driven = time < 1.9
        watch.commanded(round(time * 1e9), np.array([0.0, -0.06 if driven else 0.0, 0.0]))
        if cycle % 8 == 0:
            watch.measured(reading(time, 0.06 if time < 1.2 else 0.0))
        suspicious.append(bool(watch.suspicion))
    assert any(suspicious)
    assert not any(suspicious[40 * 5 :])
    assert watch.verdicts == ()


def _alone(axis: int, current: float) -> Predicted:
    """Return a sample of the supply current (A) while only one axis is commanded, with 40 mA."""
    commands = np.zeros((12, 3))
    commands[:, axis] = 0.04
    return predict(current, commands, BOUNDS, NEWEST)


def test_a_probe_of_few_readings_rejects_a_fault_that_explains_all_earlier_readings() -> None:
    evidence = Evidence(BOUNDS)
    two_of_three = predict(2 * FULL, np.full((12, 3), FULL), BOUNDS, NEWEST)
    evidence.add([two_of_three] * 40)
    assert [axis for axis, fault in evidence.possible_faults({}) if fault is CoilFault.OPEN] == [0, 1, 2]
    evidence.begin_segment()
    evidence.add([_alone(0, 0.04)] * 2)
    assert [axis for axis, fault in evidence.possible_faults({}) if fault is CoilFault.OPEN] == [1, 2]
    assert len(evidence) == 42


def test_cleared_evidence_contains_no_earlier_readings() -> None:
    evidence = Evidence(BOUNDS)
    evidence.add([_alone(0, 0.04)] * 3)
    evidence.begin_segment()
    evidence.add([_alone(1, 0.0)] * 2)
    assert len(evidence.possible_faults({})) < 3 * len(ELECTRICAL)
    evidence.clear()
    assert (len(evidence), evidence.readings()) == (0, [])
    assert len(evidence.possible_faults({})) == 3 * len(ELECTRICAL)
    evidence.add([_alone(2, 0.04)] * 2)
    assert not evidence.shows_working_monitor({}), "the readings are those of the first segment"
    evidence.begin_segment()
    assert not evidence.rejects_healthy_now({}), "a segment without readings contradicts nothing"
    evidence.add([_alone(2, 0.04)] * 2)
    assert evidence.shows_working_monitor({})


def test_normal_readings_of_another_coil_do_not_end_a_suspicion() -> None:
    """Readings of a probe of coil x do not end the suspicion of the undriven coil y."""
    evidence = Evidence(BOUNDS)
    evidence.add([predict(2 * FULL, np.full((12, 3), FULL), BOUNDS, NEWEST)] * 4)
    evidence.begin_segment()
    evidence.add([_alone(0, 0.04)] * 8)
    left = evidence.possible_faults({})
    assert (1, CoilFault.OPEN) in left
    assert not evidence.is_normal_again({}, left)
    evidence.add([predict(3 * FULL, np.full((12, 3), FULL), BOUNDS, NEWEST)] * 8)
    assert evidence.is_normal_again({}, left)
    evidence.add([predict(0.0, np.zeros((12, 3)), BOUNDS, NEWEST)] * 8)
    assert evidence.is_normal_again({}, left), "the currents of coils at zero are known"


def _probed_for_missing_torque(gains: FloatArray, silent: bool = False) -> tuple[CoilMonitor, FloatArray]:
    """Return a coil monitor that suspects coil z for missing torque, and the commanded currents (k, 3), A.

    A coil of gain 0 is open. If `silent`, the current monitor gives no readings after the suspicion begins.
    """
    watch, flown = CoilMonitor(CoilMonitorSettings((FULL, FULL, FULL))), []
    for cycle in range(40 * 16):
        now_ns, time = cycle * 25_000_000, cycle / 40
        wanted = np.full(3, 0.004) if watch.probe is None else watch.probe
        watch.commanded(now_ns, np.where(watch.available, wanted, 0.0))
        flown.append(wanted)
        if cycle % 8 == 0 and not (silent and time > 3.0):
            watch.measured(reading(time, float(np.abs(gains * wanted).sum())))
        if time >= 5.0:
            watch._weak = "coil z: the motion shows +0.1 of its expected torque"
            watch._probe_weak_coil(2, now_ns)
    return watch, np.array(flown)


def test_coils_that_draw_their_currents_in_the_probes_are_not_isolated_for_missing_torque() -> None:
    """Coils that draw their currents while they are probed are not isolated for missing torque.

    The torque may be missing for another reason.
    """
    watch, flown = _probed_for_missing_torque(np.ones(3))
    assert watch.verdicts == ()
    alone = np.flatnonzero(np.abs(flown).max(axis=1) > 0.03)
    order = list(dict.fromkeys(int(axis) for axis in np.abs(flown[alone]).argmax(axis=1)))
    assert order == [2, 0, 1], "the suspected axis is probed first"
    assert np.count_nonzero(flown[alone], axis=1).max() == 1
    assert len(alone) < 40 * 5.5, "the probes are not repeated within a minute"


def test_an_open_coil_that_the_motion_shows_is_isolated_after_its_probe() -> None:
    watch, flown = _probed_for_missing_torque(np.array([1.0, 1.0, 0.0]))
    assert [(verdict.axis, verdict.fault) for verdict in watch.verdicts] == [(2, CoilFault.OPEN)]
    assert np.abs(flown[:, :2]).max() < 0.03, "no other coil had to be probed"


def test_missing_torque_is_not_probed_without_readings_of_the_current_monitor() -> None:
    watch, flown = _probed_for_missing_torque(np.ones(3), silent=True)
    assert np.abs(flown).max() < 0.03
    assert watch._suspected_ns is None, "an endless suspicion would prevent the change of a sign"
    assert watch.verdicts == ()


def test_a_reversed_coil_on_the_thread_is_used_with_its_sign_changed() -> None:
    seen = observe(hold(TARGET), FAULT_AT + 14.0, [f"coil-x: reversed @ {FAULT_AT}"])
    assert seen.found == []
    ((when, text),) = seen.news
    assert FAULT_AT < when < FAULT_AT + 6.0
    assert text.startswith("coil x: ")
    assert seen.watch.correction.factors.tolist() == [-1.0, 1.0, 1.0]


@pytest.mark.parametrize("trials", [0, 2])
def test_an_open_coil_is_tried_again_while_the_body_is_slow(trials: int) -> None:
    settings = CoilMonitorSettings((FULL, FULL, FULL), tumble_rate=0.02, trial_after_ns=5, trials=trials)
    watch, quiet = CoilMonitor(settings), np.zeros(3)
    watch.commanded(0, quiet)
    for trial in range(trials):
        watch._give(1, CoilFault.OPEN, 100 * trial, "no current")
        watch.observe_motion(100 * trial + 9, np.array([0.03, 0.0, 0.0]), quiet)
        assert watch.begin_trial(100 * trial + 9) is None, "the body is too fast"
        watch.observe_motion(100 * trial + 10, np.array([0.01, 0.0, 0.0]), quiet)
        assert watch.begin_trial(100 * trial + 4) is None, "too early"
        watch._weak = "coil z: its torque is missing"
        assert watch.begin_trial(100 * trial + 5) is None, "another coil is suspected"
        watch._weak = ""
        found = watch.begin_trial(100 * trial + 5)
        assert found == (1, f"coil y is tried again, {trial + 1} of {trials}")
        assert watch.available.all()
    watch._give(1, CoilFault.OPEN, 1000, "no current")
    watch.observe_motion(1010, quiet, quiet)
    assert watch.begin_trial(2000) is None, "no trial is left"
    assert watch.available.tolist() == [True, False, True]
    watch.forget(1)
    assert watch.available.all()


def test_sound_coils_of_another_resistance_raise_no_suspicion() -> None:
    """Currents 13 % below and 10 % above their nominal values cause no suspicion.

    At 60 degrees C, the resistance of copper has changed by 15 %. The commands of all three axes change
    during the run.
    """
    seen = observe(hold(TARGET, noise=0.005, others=0.04), 20.0, gain=(0.87, 1.1, 1.0))
    assert seen.found == []
    assert seen.suspicious == 0
    assert seen.readings > 500


def test_a_faulty_monitor_is_distrusted_and_no_coil_is_isolated() -> None:
    seen = observe(hold(TARGET), 15.0, [f"monitor: wrong @ {FAULT_AT}"])
    assert seen.found == []
    assert "the monitor measures 2.0" in seen.watch.monitor_doubted


def changing(time: float, _: ImuReading) -> FloatArray:
    """Return currents that change every 2 s in all coils, as in a tumble."""
    draw = np.random.default_rng(int(time / 2.0))
    return FULL * draw.uniform(-1.0, 1.0, 3)


@pytest.mark.parametrize("law", [full, changing])
@pytest.mark.parametrize("gain", [0.3, 0.5, 0.65, 0.75, 1.4, 2.0])
def test_a_common_error_of_all_currents_is_a_fault_of_the_monitor(law: Command, gain: float) -> None:
    """No motion is known, so only the readings show that the monitor is faulty and the coils are healthy."""
    seen = observe(law, 36.0, [f"monitor: wrong (gain={gain}) @ {FAULT_AT} for 20"], monitor_only=True)
    assert seen.found == []
    assert seen.suspicious < 0.5 * seen.readings, "the suspicion does not return while the monitor is faulty"
    assert seen.watch.suspicion == ""
    assert seen.watch.monitor_doubted == "", "the monitor works again"


@pytest.mark.parametrize("law", [full, changing])
@pytest.mark.parametrize("gain", [0.8, 1.25])
def test_a_small_error_of_all_currents_isolates_no_coil(law: Command, gain: float) -> None:
    assert observe(law, 30.0, [f"monitor: wrong (gain={gain}) @ {FAULT_AT}"], monitor_only=True).found == []


@pytest.mark.parametrize("law", [full, changing])
def test_an_open_coil_is_found_with_a_monitor_whose_error_is_known(law: Command) -> None:
    faults = [f"monitor: wrong (gain=0.5) @ {FAULT_AT}", "coil-y: open @ 20"]
    seen = observe(law, 35.0, faults, monitor_only=True)
    assert [axis for _, axis, _ in seen.found] == ["y"]
    assert "the monitor measures 0.5" in seen.watch.monitor_doubted


@pytest.mark.parametrize("share", [0.25, 0.33, 0.5])
def test_an_open_coil_is_not_mistaken_for_an_error_of_the_monitor(share: float) -> None:
    """The readings during the probe of another coil show that the monitor works."""
    others = 0.5 * FULL * (1.0 - share) / max(share, 0.5)
    drawn = np.array([others, FULL * share / max(share, 0.5), others])
    seen = observe(lambda *_: drawn, 25.0, [f"coil-y: open @ {FAULT_AT}"], monitor_only=True)
    assert [axis for _, axis, _ in seen.found] == ["y"]
    assert seen.watch.monitor_doubted == ""


def test_an_axis_that_is_never_driven_is_not_judged() -> None:
    seen = observe(hold(TARGET), 12.0, ["coil-y: open @ 2", "coil-z: shorted @ 2"])
    assert seen.found == []
    assert seen.suspicious == 0


@pytest.mark.parametrize("fault", ["bridge-y: a-high", "bridge-y: b-high"])
def test_a_leg_stuck_high_is_braked_and_its_coil_carries_nothing(fault: str) -> None:
    """The brake sets both ends of the coil high, whichever leg is stuck high.

    Coil y carries its full current until the brake is set, and none afterwards.
    """
    seen = observe(hold(0.0), 10.0, [f"{fault} @ {FAULT_AT}"])
    assert seen.watch.braked == {1}
    time, carried = seen.times, np.abs(seen.carried)
    assert carried[time > FAULT_AT, 1].max() == pytest.approx(FULL, abs=4e-3)
    assert carried[time > FAULT_AT + 3.0, 1].max() == 0.0
    assert np.count_nonzero(carried[:, 1] > 0.0) * 0.025 < 2.0, "the test lets it flow for a moment only"
    assert carried[:, 2].max() == 0.0


def test_braking_that_does_not_help_is_ended() -> None:
    """The brake is released if it does not end the current: the monitor is wrong, or a leg is stuck low."""
    leg = StuckLeg(0.04)
    at_rest = Supplied(0.148, -0.002, 0.002, (0, 1, 2), False)
    asked = []
    for _ in range(6):
        assert leg.look(at_rest) is None
        asked.append(leg.brake)
    assert asked == [NO_AXES, {0, 1, 2}, {0, 1, 2}, NO_AXES, NO_AXES, NO_AXES]
    for current in (0.0, 0.0, 0.148, 0.148):
        leg.look(replace(at_rest, current=current))
    assert leg.brake == {0, 1, 2}, "once all was normal it is looked for again"


def test_a_brake_that_does_not_confirm_a_stuck_leg_is_released() -> None:
    watch = CoilMonitor(CoilMonitorSettings((FULL, FULL, FULL)))
    watch._give(0, CoilFault.A_HIGH, 0, "a guess")
    watch._proof.add(0)
    assert watch.braked == {0}
    for time in np.arange(0.0, 2.0, 0.025):
        watch.commanded(round(time * 1e9), np.zeros(3), watch.braked)
        if math.isclose(time / 0.2, round(time / 0.2), abs_tol=1e-6):
            watch.measured(reading(time, FULL))
            if not watch.braked:
                break
    assert not watch.braked
    assert not watch.available[0]


def _looks(leg: StuckLeg, stuck: Iterable[int], count: int = 40) -> list[int | None]:
    """Return the results of ADC samples at zero commands.

    Each axis with a stuck leg draws current unless its coil is braked.
    """
    drawing = set(stuck)
    found = []
    for _ in range(count):
        found.append(leg.look(Supplied(0.15 * len(drawing - leg.brake), 0.0, 0.0, (0, 1, 2), False)))
        if found[-1] is not None:
            break
    return found


@pytest.mark.parametrize("axis", range(3))
def test_the_stuck_axis_is_the_one_whose_release_lets_the_current_flow_again(axis: int) -> None:
    leg = StuckLeg(0.04)
    assert _looks(leg, {axis}, 2) == [None, None]
    assert leg.is_searching
    assert leg.brake == {0, 1, 2}
    assert leg.suspicion == "supply current 150 mA, expected 0 to 0 mA"
    # The monitor needs two normal samples with all bridges braked, and two more for each released bridge.
    assert _looks(leg, {axis}) == [None] * (2 + 2 * axis + 1) + [axis]
    assert (leg.is_searching, leg.brake, leg.rest, leg.suspicion) == (False, frozenset(), False, "")


def test_a_current_that_braking_does_not_end_is_given_up_until_it_ends() -> None:
    leg = StuckLeg(0.04)
    excess = Supplied(0.15, 0.0, 0.0, (0, 1, 2), False)
    assert [leg.look(excess) for _ in range(4)] == [None] * 4
    assert (leg.is_searching, leg.brake) == (False, frozenset())
    assert [leg.look(excess) for _ in range(20)] == [None] * 20
    assert not leg.is_searching
    _looks(leg, (), 2)
    assert _looks(leg, {1})[-1] == 1, "the search is possible again"


def test_a_rest_that_finds_nothing_is_not_repeated_for_50_samples() -> None:
    leg = StuckLeg(0.04)
    leg.ask_for_rest("no torque")
    assert (leg.is_searching, leg.suspicion, leg.brake) == (True, "no torque", frozenset())
    _looks(leg, (), 2)
    assert not leg.is_searching
    _looks(leg, (), 49)
    leg.ask_for_rest("no torque")
    assert not leg.is_searching
    _looks(leg, (), 1)
    leg.ask_for_rest("no torque")
    assert leg.is_searching


def test_a_search_without_agreement_ends_after_twelve_samples() -> None:
    leg = StuckLeg(0.04)
    leg.ask_for_rest("no torque")
    samples = [Supplied(0.15 * (k % 2), 0.0, 0.0, (0, 1, 2), False) for k in range(13)]
    searching = []
    for sample in samples:
        assert leg.look(sample) is None
        searching.append(leg.is_searching)
    assert searching == [True] * 12 + [False]


@pytest.mark.parametrize(
    ("samples", "wrong", "remains"),
    [
        ([True], [()], True),
        ([True, True], [(), (0, 2)], False),
        ([False, False], [(), ()], False),
        ([True, False, True], [(), (), ()], True),
        ([False, True, True], [(), (), (0, 2)], False),
        ([True, False, False], [(), (), ()], False),
    ],
)
def test_two_consecutive_samples_confirm_or_refute_that_a_brake_helps(
    samples: list[bool], wrong: list[tuple[int, ...]], remains: bool
) -> None:
    proof = BrakeProof()
    assert not proof
    for axis in (0, 1, 2):
        proof.add(axis)
    proof.discard(1)
    assert [tuple(sorted(proof.ingest(sample))) for sample in samples] == wrong
    assert bool(proof) is remains
    if not remains:
        proof.add(1)
        assert proof.ingest(True) == frozenset(), "the samples of an earlier brake do not count"


def reading(time: float, current: float) -> PowerReading:
    """Return a reading of the current monitor, A, at `time` s."""
    now_ns = round(time * 1e9)
    return PowerReading(now_ns, 5.0, current, 5.0 * current, current, now_ns - 300_000_000)


def test_a_stuck_leg_of_an_axis_that_is_driven_is_distinguished_from_one_that_carries_nothing() -> None:
    """A stuck leg that opposes the command draws no supply current, like an open coil.

    Only samples at zero commands distinguish a stuck leg from an open coil.
    """
    drawn = supply_currents(np.array([[-FULL]]), np.array([[FULL]]))
    assert drawn[0, PLACE[CoilFault.A_HIGH]] == pytest.approx(0.0)
    leg = StuckLeg(0.04)
    driven = Supplied(0.0, 0.08, 0.21, (1, 2), True)
    for _ in range(2):
        leg.look(driven)
    asked = [leg.rest]
    resting = Supplied(0.0, -0.002, 0.002, (0, 1, 2), False)
    for _ in range(2):
        assert leg.look(resting) is None
    asked.append(leg.rest)
    for _ in range(4):
        leg.look(driven)
    asked.append(leg.rest)
    assert asked == [True, False, False], "nothing flows: another fault; and no second rest so soon"


def windows(time: float, _: ImuReading) -> FloatArray:
    """Return the currents (A) of B-dot control in a fast rotation: off for 0.1 s and full for 0.15 s."""
    return np.array([0.0 if time % 0.25 < 0.1 else FULL, 0.0, 0.0])


def test_a_leg_stuck_high_that_drives_in_the_pauses_of_the_command_is_found() -> None:
    """A leg stuck high is found if its current in the pauses of the command equals the commanded current."""
    seen = observe(windows, FAULT_AT + 7.0, [f"bridge-x: b-high @ {FAULT_AT}"])
    assert [(axis, name) for _, axis, name in seen.found] == [("x", "HIGH")]
    assert seen.watch.braked == {0}


def test_a_check_at_rest_does_not_raise_suspicion() -> None:
    seen = observe(windows, 20.0)
    assert seen.found == []
    assert seen.suspicious == 0
    on = np.abs(seen.carried[:, 0]) > 0.9 * FULL
    assert 0.45 < np.mean(on) < 0.58, "of 0.6 a rest of half a second in five takes some"


def test_a_rest_ends_when_the_monitor_falls_silent() -> None:
    """If the current monitor gives no readings, the period with the coils off is not prolonged."""
    watch = CoilMonitor(CoilMonitorSettings((FULL, FULL, FULL)))
    rested = []
    for cycle in range(160):
        time = 0.025 * cycle
        watch.commanded(round(time * 1e9), np.zeros(3) if watch.at_rest else np.array([FULL, 0.0, 0.0]))
        if cycle % 8 == 0 and time < 1.3:
            watch.measured(reading(time, 0.0))
        rested.append(watch.at_rest)
    assert any(rested)
    assert not rested[-1]
    assert sum(rested) * 0.025 < 1.5


def wander(rng: np.random.Generator, samples: int) -> FloatArray:
    """Return typical commands (k, 3), A: slow, with steps, and often zero on two axes."""
    time = np.arange(samples) * 0.025
    commands = np.zeros((samples, 3))
    for axis in range(3):
        if axis and rng.random() < 0.5:
            continue
        size = rng.uniform(0.0, 0.1)
        commands[:, axis] = size * np.sin(rng.uniform(0.1, 1.5) * time + rng.uniform(0, 6.3))
        commands[:, axis] += rng.uniform(-0.04, 0.04)
    return np.clip(commands, -FULL, FULL)


def test_in_eight_minutes_of_wild_commands_there_is_no_false_alarm() -> None:
    """No coil is suspected in 2,388 driver readings (seed 11).

    The supply current is 0.85 to 1.15 times its expected value. Every driven coil has an error within the
    thesis's 3.5 mA in every cycle, and the readings have the resolution of the monitor. Single ADC samples
    differ from the mean of the chopped current by up to 18 %. Without a suspicion in N readings, the rate of
    suspicions is below 3 / N at 95 % confidence. Only a suspicion of a single axis leads to the decision that
    a coil is faulty.
    """
    rng = np.random.default_rng(11)
    suspected = readings = 0
    for _ in range(12):
        commands = wander(rng, 40 * 41)
        driven = np.count_nonzero(commands, axis=0) > 0
        errors = rng.uniform(-3.5e-3, 3.5e-3, commands.shape) * driven
        supply = np.abs(rng.uniform(0.85, 1.15) * commands + errors).sum(axis=1)
        in_a_row = 0
        # An ADC sample is the mean over three PWM cycles. A sample ends every eight cycles, and a reading is
        # the mean of five samples.
        conversions = np.array([supply[end - 3 : end].mean() for end in range(8, len(supply), 8)])
        chopped = conversions * rng.uniform(0.82, 1.18, len(conversions))
        for last in range(5, len(conversions)):
            end = 8 * (last + 1)
            mean = predict(
                round(conversions[last - 4 : last + 1].mean(), 4), commands[end - 44 : end], BOUNDS, MEAN
            )
            newest = predict(round(chopped[last], 4), commands[end - 12 : end], BOUNDS, NEWEST)
            sound = all(fits([one], BOUNDS, {}) for one in (mean, newest))
            in_a_row = 0 if sound else in_a_row + 1
            suspected += in_a_row >= 3
            readings += 1
    assert readings == 2_388
    assert suspected == 0


@pytest.mark.parametrize("sampling", [NEWEST, MEAN])
def test_the_fast_check_of_healthy_coils_agrees_with_the_hypothesis_of_healthy_coils(
    sampling: Sampling,
) -> None:
    rng = np.random.default_rng(5)
    answers = []
    for _ in range(400):
        commands = FULL * rng.uniform(-1.2, 1.2, 3) * (rng.random((rng.integers(1, 46), 3)) < 0.98)
        current = float(np.abs(commands).sum(axis=1).mean() * rng.uniform(0.3, 1.9))
        clipped = bool(rng.integers(0, 2))
        fast = is_healthy_current(current, commands, BOUNDS, sampling, clipped)
        assert fast == fits([predict(current, commands, BOUNDS, sampling, clipped)], BOUNDS, {})
        answers.append(fast)
    assert 40 < sum(answers) < 360


def test_a_gap_in_the_readings_restarts_the_watch() -> None:
    watch = CoilMonitor(CoilMonitorSettings((FULL, FULL, FULL)))
    currents = np.array([0.05, 0.0, 0.0])

    def feed(begin: float, end: float, current: float, period: float = 0.2) -> None:
        for time in np.arange(begin, end, 0.025):
            watch.commanded(round(time * 1e9), currents)
            if math.isclose(time / period, round(time / period), abs_tol=1e-6):
                watch.measured(reading(time, current))

    def is_suspicious() -> bool:
        return bool(watch.suspicion)

    feed(0.0, 3.0, 0.05)
    assert not is_suspicious()
    feed(3.0, 4.0, 0.0)
    assert is_suspicious()
    watch.interrupted(0)
    assert not is_suspicious()
    feed(4.0, 4.5, 0.0)
    assert not is_suspicious(), "readings from before the interruption do not count"
    feed(4.5, 9.0, 0.0)
    assert [verdict.axis for verdict in watch.verdicts] == [0]
    watch.forget(0)
    assert watch.available.all()


@pytest.mark.parametrize("probed", [False, True])
def test_the_motion_overrules_the_current_monitor_unless_a_probe_shows_that_the_monitor_works(
    probed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = CoilMonitor(CoilMonitorSettings((FULL, FULL, FULL)))
    monkeypatch.setattr(watch._witness, "contradicts", lambda *_: True)
    watch._suspect("too little current")
    watch._evidence.begin_segment()
    watch._evidence.add([_alone(1, 0.04 if probed else 0.0)])
    watch._evidence.begin_segment()
    watch._evidence.add([_alone(0, 0.0)])
    for _ in range(1 if probed else 2):  # in the second round, a probe of coil y has been recorded
        watch._conclude(0, CoilFault.OPEN, 0)
    assert bool(watch.verdicts) is probed
    assert bool(watch.monitor_doubted) is not probed


@pytest.mark.parametrize("works", [False, True])
def test_a_verdict_that_the_motion_contradicts_waits_for_the_probe_of_a_healthy_coil(
    works: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A coil is isolated only after the probe of a healthy coil has shown that the current monitor works."""
    watch = CoilMonitor(CoilMonitorSettings((FULL, FULL, FULL)))
    monkeypatch.setattr(watch._witness, "contradicts", lambda *_: True)
    gains, fails = np.array([0.0, 1.0, 1.0]), False
    probed: list[int] = []
    drawn: list[float] = []
    for cycle in range(40 * 16):
        now_ns, time = cycle * 25_000_000, cycle / 40
        wanted = np.full(3, 0.1) if watch.probe is None else watch.probe
        probed += [int(np.argmax(np.abs(wanted)))] * int(np.count_nonzero(wanted) == 1)
        watch.commanded(now_ns, np.where(watch.available, wanted, 0.0))
        # The current monitor fails during the probe of coil x, and measures nothing afterwards.
        fails = not works and (fails or np.count_nonzero(wanted) == 1)
        drawn.append(float(np.abs(wanted) @ (np.ones(3) if time < 4.0 else gains)) * (not fails))
        if cycle % 8 == 0:
            watch.measured(replace(reading(time, drawn[-1]), current=float(np.mean(drawn[-44:]))))
        if watch.verdicts or watch.monitor_doubted:
            break
    assert list(dict.fromkeys(probed)) == [0, 1], "the suspected coil is probed, and then another coil"
    assert [verdict.axis for verdict in watch.verdicts] == ([0] if works else [])
    assert bool(watch.monitor_doubted) is not works
