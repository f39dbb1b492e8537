"""Tests that the ground updates a board under systemd over the link, with a real release."""

from __future__ import annotations

import re
from typing import Any

import pytest

from tests.deploy import container

REASON = container.why_not()
pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(REASON), reason=REASON), pytest.mark.timeout(3600)]


@pytest.fixture(scope="module")
def observations(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return container.boot(tmp_path_factory.mktemp("machine"), container.RENEWALS)


def test_the_ground_reaches_the_board(observations: dict[str, Any]) -> None:
    status, printed = observations["ping"]
    assert status == 0, printed


@pytest.mark.parametrize("kind", ["configuration", "release"])
def test_each_command_of_a_renewal_succeeds(observations: dict[str, Any], kind: str) -> None:
    for step in ("sign", "put", "activate", "confirm"):
        status, printed = observations[kind]["steps"][step]
        assert status == 0, f"{step}: {printed}"


def test_the_new_configuration_is_flown(observations: dict[str, Any]) -> None:
    assert observations["configuration"]["is_second"]


def test_flight_and_link_run_the_new_release(observations: dict[str, Any]) -> None:
    (first, _), flown = observations["first"], observations["release"]["flown"]
    assert re.fullmatch(r"\d+\.\d+\.\d+\+1", first)
    assert flown == [flown[0]] * 2
    assert flown[0].endswith("+2")


def test_a_release_whose_service_does_not_fly_is_replaced_by_the_previous_one(
    observations: dict[str, Any],
) -> None:
    status, printed = observations["broken"]["steps"]["activate"]
    assert status != 0 or observations["broken"]["steps"]["confirm"][0] != 0, printed
    assert observations["broken"]["flown"] == observations["release"]["flown"]
