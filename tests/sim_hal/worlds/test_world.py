"""Tests that a configuration selects the world of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.schema import reader as configuration
from flight.schema.document import ConfigError
from tests.sim_hal.worlds.spinning_world import RATE
from tests.support.flights import demo_config, demo_world, fly

HERE = "tests.sim_hal.worlds.spinning_world"


def test_a_world_of_a_third_party_is_flown_and_its_motion_reaches_estimate_and_truth(tmp_path: Path) -> None:
    section = configuration.replace(demo_world(), world=f"{HERE}:make")
    run = fly(demo_config(4.0, camera=False), tmp_path, section=section)
    seconds = run["truth"]["time_ns"] * 1e-9
    np.testing.assert_allclose(2.0 * np.arcsin(run["truth"]["quaternion"][:, 1]), RATE * seconds, atol=1e-9)
    last = run["control"][-1]
    assert last["angle"] == pytest.approx(RATE * last["time_ns"] * 1e-9, abs=0.01)
    assert last["rate"] == pytest.approx(RATE, abs=2e-3)


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("moon", "name one of testbed"),
        ("no_such_module:make", "cannot be imported"),
        (f"{HERE}:missing", "cannot be imported"),
        (f"{HERE}:NO_FACTORY", "returns no World"),
        (f"{HERE}:make_nothing", "returns no World"),
        ("os:system", "whose function `system` failed: TypeError"),
    ],
)
def test_a_missing_world_is_reported_in_one_line(name: str, complaint: str, tmp_path: Path) -> None:
    section = configuration.replace(demo_world(), world=name)
    with pytest.raises(ConfigError, match=complaint) as caught:
        fly(demo_config(1.0, camera=False), tmp_path, section=section)
    assert str(caught.value).startswith("simulation.world")
