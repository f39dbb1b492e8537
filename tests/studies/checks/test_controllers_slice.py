"""Runs a slice of the control campaigns: lower bound, a world that differs from the model, and the table."""

from __future__ import annotations

from pathlib import Path

import pytest

from flight.schema import reader as configuration
from ground.campaigns.runner import Case
from sim_hal.settings import Thread
from tests.studies.campaigns import controllers
from tests.support.flights import demo_config, demo_world
from tests.support.ideal_power import clairvoyant_power


@pytest.mark.parametrize(("stiffness", "milliwatts"), [(0.0, 3.81), (1e-5, 8.52), (2e-5, 25.05)])
def test_the_clairvoyant_optimum_is_the_one_that_was_computed_elsewhere(
    stiffness: float, milliwatts: float
) -> None:
    """The values are from a Hermite-Simpson collocation with an interior-point solver (issue 2)."""
    thread = Thread(stiffness=stiffness, damping=2e-6 if stiffness else 0.0)
    world = configuration.replace(demo_world(), thread=thread)
    power = clairvoyant_power(demo_config(700.0), world)
    assert 1e3 * power == pytest.approx(milliwatts, abs=0.01)


def test_every_controller_flies_its_own_configuration() -> None:
    configs = {name: make() for names in controllers.THREADS.values() for name, make in names.items()}
    assert {config.control.tracker for config in configs.values()} == {"lq", "thesis", "pid", "adaptive"}
    for config in configs.values():
        assert config.steps == configs["this loop"].steps
        assert config.camera is None


def test_both_threads_are_flown_and_reported_apart() -> None:
    """Summarise two invented flights; their world differs from the demonstration's only in stiffness."""
    cases = controllers.cases(2, 1)
    stiff = [case for case in cases if case.parameters["thread"] == controllers.THICK]
    assert len(stiff) == 2 * len(controllers.STIFF)
    assert len({case.key for case in cases}) == len(cases)
    ours = controllers.world(controllers.OURS, 7)
    thread = configuration.replace(ours.thread, stiffness=4.2e-5)
    assert controllers.world(controllers.THICK, 7) == configuration.replace(ours, thread=thread)
    drawn = {name: 1.0 for name in controllers.FIGURES} | {"supply_w": 0.2}
    results = [
        {**drawn, "controller": name, "thread": controllers.THICK, "flight_seed": 1, "heat_w": heat}
        for name, heat in (("this loop", 0.10), ("pid", 0.101))
    ]
    facts = controllers.summarise(results, Path()).facts
    assert "controllers" not in facts
    assert facts["stiff controllers"]["pid"]["over_this_loop"] == pytest.approx(1.01)
    assert facts["stiff controllers"]["adaptive"] == {"seeds": 0}


def test_worlds_differ_and_stay_within_their_bounds() -> None:
    worlds = [controllers.draw((1, run)) for run in range(200)]
    for name, low, high in (
        ("inertia", 0.8, 1.2),
        ("field", 0.9, 1.1),
        ("resistance", 0.9, 1.1),
        ("stiffness", 0.0, 3.0),
        ("noise", 1.0, 3.0),
        ("delay_cycles", 1, 3),
    ):
        values = [world[name] for world in worlds]
        assert low <= min(values) < low + 0.05 * (high - low) + 1e-9
        assert high - 0.05 * (high - low) - 1e-9 < max(values) <= high
    assert max(span for world in worlds for _, span in world["dropouts_s"]) <= 1.0
    assert controllers.draw((1, 0)) == worlds[0]


@pytest.mark.slow
def test_a_world_unlike_the_loops_belief_is_flown_to_its_targets() -> None:
    """The loop of this project is simulated in world 1 of seed 1."""
    result = controllers.robust_run(Case("this loop/1", (1, 1), {"controller": "this loop"}))
    assert not result["lost"]
    assert result["settling_s"] < 12.0
    assert result["steady_state_deg"] < 0.15
    assert result["excursion_deg"] < 1.0
    assert {"imu-silent", "imu-corrupt", "control-lost", "control-regained"} <= set(result["events"])


def test_the_table_counts_the_lost_and_shows_the_percentile(tmp_path: Path) -> None:
    world = controllers.draw((1, 0))
    results = [
        {
            "world": world,
            "controller": "pid",
            "heat_w": 0.02,
            "steady_state_deg": 0.01 * k,
            "excursion_deg": 0.02 * k,
            "settling_s": 8.0 + 0.01 * k if k < 99 else float("inf"),
            "overshoot_percent": 0.1,
            "rise_s": 6.0,
            "lost": k == 99,
        }
        for k in range(100)
    ]
    facts = controllers.robust_summarise(results, tmp_path).facts["pid"]
    assert facts["lost"] == 1
    assert facts["steady_state_deg"][1] == pytest.approx(0.94)
    assert facts["settling_s"][2] is None
