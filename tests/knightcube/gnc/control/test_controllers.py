"""Tests that each name in a configuration gives its controller, and that all have the same interface."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from flight.bodies.testbed.control import controller_of
from flight.schema.bodies import Control, Identification
from knightcube.errors import UsageError
from knightcube.gnc.control.one_axis import AngleController, LqTracker
from knightcube.gnc.guidance.plant import PathSample, SingleAxisPlant
from knightcube.reference.control import AdaptiveController, AdaptiveSettings, PidController, PidSettings
from tests.support.thread_loop import BELIEVED, PERIOD, fly, held, largest_error

WEIGHTS = 20.0, 1.0
PUSHED = replace(BELIEVED, disturbance=4e-3)
THREAD = replace(BELIEVED, stiffness=2e-5, damping=2e-6)


@pytest.mark.parametrize("true", [PUSHED, THREAD], ids=["constant torque", "thread"])
def test_the_tracker_holds_without_offset_where_the_thesis_keeps_one(true: SingleAxisPlant) -> None:
    """The LQ tracker holds the attitude within 0.03 deg, without the offset of the thesis's tracker.

    The thesis's tracker has an offset of torque / stiffness, d / K_e = 4e-3 / 4.47 rad, which is 0.051 deg.
    """
    target = 0.5 if true is THREAD else 0.3
    errors = {}
    for thesis in (False, True):
        rows = fly(
            LqTracker(BELIEVED, *WEIGHTS, as_in_thesis=thesis), true, held(target), 30.0, (target, 0.0)
        )
        errors[thesis] = largest_error(rows, target, 10.0)
    torque = true.stiffness / true.inertia * target - true.disturbance
    offset = np.degrees(abs(torque) / LqTracker(BELIEVED, *WEIGHTS).error_gain)
    assert errors[False] < 0.03
    assert errors[True] == pytest.approx(offset, abs=0.03)


@pytest.mark.parametrize(
    "controller",
    [
        LqTracker(BELIEVED, *WEIGHTS),
        PidController(BELIEVED, PERIOD, PidSettings.placed(0.76), 0.0),
        AdaptiveController(BELIEVED, PERIOD, AdaptiveSettings(1.0, 10.0, 0.55)),
    ],
    ids=["lq", "pid", "adaptive"],
)
def test_all_controllers_bring_the_body_to_the_target_under_the_thread(controller: AngleController) -> None:
    """After a step of 0.1 rad, which is within the coil's limit, the error is below 0.15 deg.

    Before the error is checked, the adaptive controller has adapted its gains.
    """
    rows = fly(controller, replace(THREAD, stiffness=1e-5), held(0.1), 60.0)
    assert largest_error(rows, 0.1, 10.0) < 0.15
    assert rows[:, 1].max() < 0.1 * 1.05


@pytest.mark.parametrize("size", [0.1, 0.3, 0.7, -0.7])
@pytest.mark.parametrize("true", [PUSHED, THREAD, BELIEVED], ids=["constant torque", "thread", "as believed"])
def test_a_sudden_step_that_saturates_the_coil_neither_overshoots_nor_winds_up(
    true: SingleAxisPlant, size: float
) -> None:
    rows = fly(LqTracker(BELIEVED, *WEIGHTS), true, held(size), 30.0)
    if abs(size) >= 0.3:
        assert (np.abs(rows[:, 3]) >= 0.148 - 1e-9).sum() > 20
    assert (rows[:, 1] / size).max() < 1.02
    assert largest_error(rows, size, 5.0) < 0.03


def test_the_thesis_tracker_overshoots_a_sudden_step() -> None:
    """The thesis's tracker overshoots a step of 0.7 rad, because it needs a planned path.

    For a step, the tracker begins to brake so late that the coil's torque cannot stop the body in time.
    """
    rows = fly(LqTracker(BELIEVED, *WEIGHTS, as_in_thesis=True), BELIEVED, held(0.7), 30.0)
    assert rows[:, 1].max() > 0.7 * 1.3


KINDS = {"lq": LqTracker, "thesis": LqTracker, "pid": PidController, "adaptive": AdaptiveController}


@pytest.mark.parametrize("name", KINDS)
def test_each_name_gives_its_controller(name: str) -> None:
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
    """Only the LQ tracker compensates the estimated disturbance, by J / (n A B) = 3.6 A per rad/s^2.

    J / (n A B) is the current per acceleration at theta = 0.
    """
    rest = PathSample(0.0, 0.0, 0.0)
    for name in KINDS:
        controller = controller_of(Control(tracker=name), BELIEVED, 0.025, Identification())  # type: ignore[arg-type]  # any of KINDS
        current = controller.command(rest, 0.0, 0.0, 0.01).current
        expected = -0.01 * BELIEVED.inertia / BELIEVED.torque_constant if name == "lq" else 0.0
        assert current == pytest.approx(expected, abs=1e-9)
