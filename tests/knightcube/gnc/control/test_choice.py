"""Each name in a configuration means its controller, and all of them keep to one interface."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flight.bodies.testbed.control import controller_of
from flight.schema.testbed import Control, Identification
from knightcube.errors import UsageError
from knightcube.gnc.control.one_axis.lq_tracker import LqTracker
from knightcube.gnc.guidance.one_axis.path import PathSample
from knightcube.reference.control import AdaptiveController, PidController
from tests.knightcube.gnc.control.closed_loop import BELIEVED

KINDS = {"lq": LqTracker, "thesis": LqTracker, "pid": PidController, "adaptive": AdaptiveController}


@pytest.mark.parametrize("name", KINDS)
def test_a_name_means_its_controller(name: str) -> None:
    controller = controller_of(Control(tracker=name), BELIEVED, 0.025, Identification())  # type: ignore[arg-type]  # any of KINDS
    assert isinstance(controller, KINDS[name])
    rng = np.random.default_rng(2)
    for numbers in rng.normal(0.0, 0.5, (200, 6)).tolist():
        made = controller.command(PathSample(*numbers[:3]), *numbers[3:])
        assert abs(made.current) <= BELIEVED.current_limit
        assert made.saturated == (made.current != made.demanded)
    for position in range(6):
        spoilt = [0.1] * 6
        spoilt[position] = math.nan
        with pytest.raises(UsageError, match="not finite"):
            controller.command(PathSample(*spoilt[:3]), *spoilt[3:])
    controller.reset()


def test_only_the_lq_tracker_feeds_the_estimated_disturbance_forward() -> None:
    """3.6 A per rad/s^2 at theta = 0: what J / (n A B) says."""
    rest = PathSample(0.0, 0.0, 0.0)
    for name in KINDS:
        controller = controller_of(Control(tracker=name), BELIEVED, 0.025, Identification())  # type: ignore[arg-type]  # any of KINDS
        current = controller.command(rest, 0.0, 0.0, 0.01).current
        expected = -0.01 * BELIEVED.inertia / BELIEVED.torque_constant if name == "lq" else 0.0
        assert current == pytest.approx(expected, abs=1e-9)
