"""Tests that crashes are counted by operating time, and forgotten only after a period of operating time.

The parameters that are estimated in one boot are the prior of the next boot, with a larger covariance.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flight.link import events
from flight.loop.state import (
    GYRO_BIAS,
    IMU_LATENCY,
    PLANT,
    REMEMBERED,
    BootRecord,
    KeptTable,
    Learned,
    Noted,
    Notices,
    StateKeeper,
    StateStore,
    StoredState,
    begin_boot,
    boot_record,
    digest_of,
    end_cleanly,
    learned_of,
    start_from,
    state_after,
)
from flight.schema import reader as configuration
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter, slow_prior
from knightcube.gnc.estimation.estimate import PARAMETERS, Estimate, Parameters
from tests.flight.loop.disk import Disk
from tests.knightcube.gnc.estimation.flights import SETTINGS, SUSPENDED, Flight, fly, follow
from tests.manual_clock import ManualClock
from tests.support import flights
from tests.support.consistency_worlds import CYCLE_NS

LABEL = "1970-01-01T00:00:00Z"


def boot(state: StoredState, seconds: float, clean: bool, utc: str = LABEL) -> StoredState:
    """Return the crash record after one boot."""
    begun = begin_boot(state, utc)
    state = state_after(begun, seconds, Noted("hold", {}, begun.table), utc)
    return end_cleanly(state) if clean else state


def test_the_first_boot_has_no_past() -> None:
    assert boot_record(begin_boot(StoredState(), LABEL), 600.0) == BootRecord(1, 0, False, "")


def test_an_unclean_shutdown_is_remembered_and_a_clean_one_is_not() -> None:
    state = boot(boot(StoredState(), 100.0, clean=True), 100.0, clean=False)
    assert boot_record(begin_boot(state, LABEL), 600.0) == BootRecord(3, 1, True, "hold")
    state = boot(state, 100.0, clean=True)
    assert boot_record(begin_boot(state, LABEL), 600.0) == BootRecord(4, 1, False, "hold")
    assert [crash.boot for crash in begin_boot(state, LABEL).unclean] == [2]


def test_a_crash_is_recent_until_the_application_has_run_for_the_window() -> None:
    state = boot(StoredState(), 50.0, clean=False)
    for ran, recent in ((600.0, 1), (600.5, 0)):
        assert boot_record(begin_boot(boot(state, ran, clean=True), LABEL), 600.0).unclean_recent == recent


def test_crashes_at_once_are_never_forgotten_by_waiting() -> None:
    state = StoredState()
    for number in range(1, 6):
        state = boot(state, 0.0, clean=False, utc=f"20{number}0-01-01T00:00:00Z")
        assert boot_record(begin_boot(state, LABEL), 600.0).unclean_recent == number


def test_a_wrong_clock_changes_only_the_labels() -> None:
    honest, lying = StoredState(), StoredState()
    for number, clean in enumerate((False, True, False, False)):
        honest = boot(honest, 40.0, clean, f"2026-01-0{number + 1}T00:00:00Z")
        lying = boot(lying, 40.0, clean, f"{(2099, 1970, 2038, 1901)[number]}-01-01T00:00:00Z")
    assert boot_record(begin_boot(honest, LABEL), 100.0) == boot_record(begin_boot(lying, LABEL), 100.0)
    assert honest.unclean[0].utc == "2026-01-01T00:00:00Z"


def test_only_the_newest_crashes_are_kept() -> None:
    state = StoredState()
    for _ in range(REMEMBERED + 10):
        state = boot(state, 1.0, clean=False)
    crashes = begin_boot(state, LABEL).unclean
    assert len(crashes) == REMEMBERED
    assert crashes[-1].boot == state.boot_count


def test_newly_estimated_values_replace_old_ones_and_the_others_stay() -> None:
    first, second = Learned((1.0,), ((0.1,),)), Learned((2.0,), ((0.1,),))
    begun = begin_boot(StoredState(learned={"a": first, "b": first}), LABEL)
    state = state_after(begun, 1.0, Noted("", {"a": second}, begun.table), LABEL)
    assert state.learned == {"a": second, "b": first}


def test_an_unproven_table_is_replaced_by_the_previous_one_after_a_crash() -> None:
    new = KeptTable(values={"modes.known_for": 2.0}, before={"modes.known_for": 3.0}, proven=False, loads=2)
    proven = KeptTable(values=new.values, before=new.before, proven=True, loads=2)
    for table, clean, flown in ((new, False, 3.0), (new, True, 2.0), (proven, False, 2.0)):
        state = begin_boot(StoredState(running=not clean, table=table), LABEL)
        assert state.table.values == {"modes.known_for": flown}
        assert state.table.loads == 2
    # The rejected table is not tried again, and the former table remains in use after a second crash.
    again = begin_boot(begin_boot(StoredState(running=True, table=new), LABEL), LABEL)
    assert again.table.values == new.before


@given(st.lists(st.tuples(st.floats(0.0, 1e5), st.booleans()), max_size=20), st.floats(0.0, 1e5))
def test_the_count_is_that_of_the_crashes_in_the_window(
    boots: list[tuple[float, bool]], window: float
) -> None:
    state, ends, ran = StoredState(), [], 0.0
    for seconds, clean in boots:
        state = boot(state, seconds, clean)
        ran += seconds
        if not clean:
            ends.append(ran)
    begun = begin_boot(state, LABEL)
    record = boot_record(begun, window)
    assert record.unclean_recent == sum(ran - at <= window for at in ends)
    assert record.boot_count == len(boots) + 1
    assert all(a.operated <= b.operated for a, b in pairwise(begun.unclean))


BOOT, SETTLED, AGAIN = 0, 600, 640
"""Cycle numbers at the start of the first boot, at its end, and at the end of the second boot, which lasts
one second."""
CHANGED = 0.3


def booted(flown: Flight, begin: int, end: int, learned: dict[str, Learned]) -> Estimate:
    """Return the last estimate of a filter that runs in the cycles `begin` to `end` - 1 of a flight."""
    prior, problems = start_from(learned, slow_prior(SUSPENDED, SETTINGS), CHANGED)
    assert not problems
    filter_ = AttitudeFilter(SUSPENDED, SETTINGS, prior)
    filter_.command(begin * CYCLE_NS, flown.commands[begin], flown.fields[begin])
    filter_.start(*flown.samples[begin])
    follow(filter_, flown, begin + 1, end)
    return filter_.at((end - 1) * CYCLE_NS)


def error(estimate: Estimate, flown: Flight) -> FloatArray:
    """Return the errors of torsion, damping and gain, relative to the standard deviations of the prior."""
    spread = np.sqrt(np.diag(slow_prior(SUSPENDED, SETTINGS).parameters_covariance))
    return np.asarray((np.array(estimate.parameters) - np.array(flown.parameters)) / spread)


def test_the_second_boot_knows_the_plant_better_after_a_second_than_the_first_did() -> None:
    """A filter that begins with learned parameters has smaller errors after one second than a new filter.

    The errors are rms values over four plants. The damping is hardly observable in the 15 s of the first
    boot.
    """
    begun, begun_again = [], []
    for seed in range(4):
        flown = fly(seed, AGAIN, suspended=True)
        learned = learned_of(booted(flown, BOOT, SETTLED, {}))
        begun.append(error(booted(flown, SETTLED, AGAIN, {}), flown))
        again = booted(flown, SETTLED, AGAIN, learned)
        begun_again.append(error(again, flown))
        spread = np.sqrt(np.diag(again.covariance[PARAMETERS, PARAMETERS]))
        off = np.abs(np.array(again.parameters) - np.array(flown.parameters)) / spread
        assert off.max() < 3.5, "its spread is honest"
    first, second = (np.sqrt(np.mean(np.square(errors), axis=0)) for errors in (begun, begun_again))
    better = dict(zip(Parameters._fields, (second / first).tolist(), strict=True))
    assert better["torsion"] < 0.4
    assert better["gain"] < 0.4
    assert better["damping"] < 1.0


def test_possible_changes_increase_the_prior_variances_and_known_values_stay_known() -> None:
    believed = slow_prior(SUSPENDED, SETTINGS)
    learned = {GYRO_BIAS: Learned.of(np.array([5e-4, 4e-4, 0.0]), np.diag([0.0, 1e-10, 0.0]))}
    prior, problems = start_from(learned, believed, CHANGED)
    assert not problems
    assert prior.bias.tolist() == [0.0, 4e-4, 0.0], "about x and z a body on the thread has no bias"
    assert np.diag(prior.bias_covariance) == pytest.approx([0.0, 1e-10 + (0.3 * 1e-3) ** 2, 0.0])
    assert prior.parameters == believed.parameters, "of what was not learned the belief holds"


@pytest.mark.parametrize(
    ("name", "values", "why"),
    [
        (PLANT, [0.0, 0.0, 1.45], "not within 4 sigma"),
        (GYRO_BIAS, [0.0, -0.02, 0.0], "not within 4 sigma"),
        (GYRO_BIAS, [0.0], "3 values are required"),
    ],
)
def test_impossible_stored_values_are_reported_and_not_used(name: str, values: list[float], why: str) -> None:
    believed = slow_prior(SUSPENDED, SETTINGS)
    learned = {name: Learned.of(np.array(values), np.eye(len(values)) * 1e-12)}
    prior, (problem,) = start_from(learned, believed, CHANGED)
    assert name in problem
    assert why in problem
    assert (prior.bias.tolist(), prior.parameters) == (believed.bias.tolist(), believed.parameters)


def test_an_age_that_is_known_for_sure_is_not_learned() -> None:
    learned = {IMU_LATENCY: Learned.of(np.array([0.05]), np.array([[1e-6]]))}
    prior, problems = start_from(learned, slow_prior(SUSPENDED, SETTINGS), CHANGED)
    assert (problems, prior.latency, prior.latency_variance) == ([], 0.0, 0.0)


def keeper_on(disk: Disk, devices: str) -> StateKeeper:
    notices = Notices()
    store = StateStore(Path("/state"), notices.report, disk)
    return StateKeeper(store, notices, ManualClock(), period_ns=10_000_000_000, devices=devices)


def test_estimates_for_other_devices_are_discarded_and_reported() -> None:
    disk = Disk()
    learned = {PLANT: Learned.of(np.array([0.01, 1e-3, 1.1]), np.eye(3) * 1e-8)}
    first = keeper_on(disk, "a")
    first.note("hold", learned)
    first.close(clean=True)
    same = keeper_on(disk, "a")
    assert same.learned == learned
    assert not same.notices()
    same.close(clean=True)
    other = keeper_on(disk, "b")
    assert not other.learned
    ((kind, _),) = other.notices()
    assert kind is events.LEARNED_REFUSED
    other.close(clean=True)
    assert not keeper_on(disk, "b").notices(), "reported once"


def test_a_changed_configuration_of_the_plant_counts_as_another_plant() -> None:
    config = flights.demo_config(1.0)
    heavier = configuration.replace(config, plant=configuration.replace(config.plant, inertia=2e-3))
    longer = configuration.replace(config, duration=2.0)
    assert digest_of(config) == digest_of(longer)
    assert digest_of(config) != digest_of(heavier)


def test_a_flight_begins_where_the_last_one_ended_and_from_nothing_with_a_lost_state(tmp_path: Path) -> None:
    def torsion_after(seconds: float, folder: Path, run: str) -> tuple[float, float, list[str]]:
        """Simulate a run; return the stored torsion of the thread, its standard deviation, and the events."""
        config = flights.demo_config(seconds, camera=False)
        config = configuration.replace(config, state=configuration.replace(config.state, folder=str(folder)))
        names = flights.event_names(flights.fly(config, tmp_path / run))
        values, covariance = StateStore(folder, lambda *_: None).load().learned[PLANT].arrays()
        return float(values[0]), float(covariance[0, 0]) ** 0.5, names

    true = flights.demo_world().thread.stiffness / flights.demo_config(1.0).plant.inertia
    first, wide, _ = torsion_after(2.0, tmp_path / "new", "first")
    kept = tmp_path / "kept"
    torsion_after(12.0, kept, "long")
    second, narrow, names = torsion_after(2.0, kept, "second")
    assert abs(second - true) < 0.5 * abs(first - true)
    assert narrow < 0.5 * wide
    assert "learned-refused" not in names
    for copy in kept.glob("state-*.json"):
        copy.write_bytes(b"of no use\n")
    third, as_wide, names = torsion_after(2.0, kept, "third")
    assert "state-lost" in names
    assert (third, as_wide) == (first, wide), "it begins as the first boot did"
