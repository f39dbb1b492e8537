"""Tests that the coils carry no current within half a second after any end of the flight process."""

from __future__ import annotations

import numpy as np
import pytest

from tests.hal.guardian.campaign import UNGUARDED, Campaign, Hurt, hurt_in_every_way
from tests.hal.guardian.live_flight import DRIVEN_A
from tests.support.flights import event_names

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    return hurt_in_every_way(tmp_path_factory.mktemp("hurt"))


def _hurt(campaign: Campaign, act: str) -> Hurt:
    (found,) = (hurt for hurt in campaign.hurts if hurt.act == act)
    assert abs(found.current) > DRIVEN_A, "the coil was driven when the act came"
    return found


@pytest.mark.parametrize("act", ["SIGSTOP", "hang, other threads alive", "hang, interpreter held", "kill -9"])
def test_the_coils_are_at_zero_half_a_second_after(campaign: Campaign, act: str) -> None:
    assert _hurt(campaign, act).zero_after <= 0.5


def test_a_killed_flight_is_seen_at_once_and_not_after_the_time_out(campaign: Campaign) -> None:
    assert _hurt(campaign, "kill -9").zero_after < 0.25


def test_without_its_guardian_a_stopped_flight_drives_the_coils_on(campaign: Campaign) -> None:
    after = [_hurt(campaign, act).zero_after for act in UNGUARDED]
    assert float("inf") in after, "the coil current stays, so the other tests of this file can fail"


@pytest.mark.parametrize("act", ["SIGSTOP", "hang, other threads alive", "hang, interpreter held"])
def test_control_comes_back_by_itself_within_two_seconds(campaign: Campaign, act: str) -> None:
    recovered = _hurt(campaign, act).recovered
    assert recovered is not None
    assert recovered <= 2.0


def test_a_guardian_that_is_killed_or_hangs_is_replaced_and_reported(campaign: Campaign) -> None:
    assert len(set(campaign.guardians)) == 3
    assert event_names(campaign.truth.run).count("guardian-ready") >= 2
    events = campaign.truth.run["event"]
    reported = events["time_ns"][events["name"] == b"guardian-lost"] + campaign.truth.epoch_ns
    # On a busy machine, a new guardian can be replaced too, because it does not read its line yet.
    killed, stopped = ((reported[reported > lost] - lost)[0] * 1e-9 for lost in campaign.guardian_lost_ns)
    assert killed < 0.5, "a death is seen at once"
    assert stopped < 2.0, "a line that is not read fills up"


def test_a_lost_guardian_does_not_disturb_the_flight(campaign: Campaign) -> None:
    truth = campaign.truth
    begin_ns = campaign.guardian_lost_ns[0]
    inside = (truth.time_ns > begin_ns) & (truth.time_ns < begin_ns + 2_000_000_000)
    assert np.mean(truth.current[inside] == 0.0) < 0.1


def test_no_guardian_outlives_its_flight(campaign: Campaign) -> None:
    assert campaign.left_over == []
