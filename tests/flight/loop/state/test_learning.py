"""Parameters learned in one boot are the prior of the next, with an increased covariance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.link import events
from flight.loop.state.content import Learned
from flight.loop.state.keeper import Notices, StateKeeper
from flight.loop.state.learning import GYRO_BIAS, IMU_LATENCY, PLANT, digest_of, learned_of, start_from
from flight.loop.state.store import StateStore
from flight.schema import reader as configuration
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter
from knightcube.gnc.estimation.estimate import PARAMETERS, Estimate
from knightcube.gnc.estimation.filter_settings import slow_prior
from knightcube.gnc.estimation.rigid_body import Parameters
from tests.flight.loop.state.disk import Disk
from tests.knightcube.gnc.estimation.flights import SETTINGS, SUSPENDED, Flight, fly, follow
from tests.manual_clock import ManualClock
from tests.scenario import flights
from tests.studies.campaigns.consistency_worlds import CYCLE_NS

BOOT, SETTLED, AGAIN = 0, 600, 640
"""Cycles: the end of the first boot, and the end of the second, a second after its start."""
CHANGED = 0.3


def booted(flown: Flight, begin: int, end: int, learned: dict[str, Learned]) -> Estimate:
    """Return the estimate of a boot that flies some cycles of a flight."""
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
    """Four plants; rms of each parameter. In the first boot's 15 s the damping is hardly observable."""
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


def test_what_may_have_changed_widens_the_start_and_what_is_known_stays_known() -> None:
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
        (GYRO_BIAS, [0.0], "3 values are wanted"),
    ],
)
def test_what_cannot_be_true_is_not_taken_and_reported(name: str, values: list[float], why: str) -> None:
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
    return StateKeeper(store, notices, ManualClock(), window=600.0, period_ns=10_000_000_000, devices=devices)


def test_what_was_learned_of_other_devices_is_forgotten_and_reported() -> None:
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


def test_a_plant_that_is_configured_otherwise_is_another_one() -> None:
    config = flights.demo_config(1.0)
    heavier = configuration.replace(config, plant=configuration.replace(config.plant, inertia=2e-3))
    longer = configuration.replace(config, duration=2.0)
    assert digest_of(config) == digest_of(longer)
    assert digest_of(config) != digest_of(heavier)


def test_a_flight_begins_where_the_last_one_ended_and_from_nothing_with_a_lost_state(tmp_path: Path) -> None:
    def torsion_after(seconds: float, folder: Path, run: str) -> tuple[float, float, list[str]]:
        """Fly; return the stored torsion of the thread, its sigma, and the events."""
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
