"""Tests of the installed service under systemd: after each induced failure, the coils carry no current."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.deploy import container

REASON = container.why_not()
pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(REASON), reason=REASON), pytest.mark.timeout(1200)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("machine")


@pytest.fixture(scope="module")
def observations(folder: Path) -> dict[str, Any]:
    return container.boot(folder)


def test_the_service_starts_and_reports_that_it_is_ready(observations: dict[str, Any]) -> None:
    assert observations["active"] == "active"
    # Without CAP_SYS_RESOURCE, systemd cannot raise the real-time limits of the service.
    granted, *refused = observations["status"].removeprefix("flying; ").split("; ")
    assert granted == "SCHED_FIFO 50, memory locked" or refused


@pytest.mark.parametrize(
    ("act", "result", "limit"),
    [("killed", "signal", 0.5), ("killed with its guardian", "signal", 1.5), ("stopped", "watchdog", 0.5)],
)
def test_the_coils_are_at_zero_and_the_service_restarts(
    observations: dict[str, Any], act: str, result: str, limit: float
) -> None:
    """ExecStopPost zeroes the coils if guardian and flight are killed together.

    The watchdog ends a stopped flight. On a busy machine systemd responds later than the guardian, so the
    limit of ExecStopPost is 1.5 s instead of 0.5 s.
    """
    facts = observations[act]
    assert facts["zero_after"] is not None
    assert facts["zero_after"] <= limit
    assert facts["flies_again"] is not None
    assert facts["result"] == result


def test_each_death_caused_one_restart(observations: dict[str, Any]) -> None:
    assert observations["restarts"] == 3


def test_the_renewal_runs_in_its_sandbox_and_has_systemd_restart_the_flight(
    observations: dict[str, Any],
) -> None:
    assert observations["renewal"] == {
        "result": "success",
        "left_alone": True,
        "restarted": True,
        "status": True,
        "ground": True,
        "flag": False,
    }


def test_a_command_over_its_socket_is_answered(observations: dict[str, Any]) -> None:
    assert observations["commanded"].startswith("executed: "), observations["commanded"]


def test_the_service_waits_while_its_configuration_has_a_flipped_bit(observations: dict[str, Any]) -> None:
    assert observations["damaged"] == {"driven": False, "state": "activating", "restarted": False}


def test_the_service_cannot_open_devices_that_are_not_configured(observations: dict[str, Any]) -> None:
    assert observations["devices_closed"]


def test_a_stop_by_systemd_is_a_success(observations: dict[str, Any]) -> None:
    assert observations["end"] == {"driven": False, "result": "success", "reported": "success"}


def test_without_a_release_the_service_fails_and_the_safe_state_tries_it_again(
    observations: dict[str, Any],
) -> None:
    assert observations["broken"] == {"tried_again": True, "safe_state_ended": True}


@pytest.mark.parametrize("name", ["board_testbed", "board_orbit"])
def test_a_boards_configuration_flies_in_the_sandbox_with_frames_rates_and_every_device(
    observations: dict[str, Any], name: str
) -> None:
    ended = {"active": "active", "driven": True, "arrived": True, "at_zero": True, "result": "success"}
    assert observations["boards"][name] == ended


def test_a_second_installation_changes_nothing(observations: dict[str, Any], folder: Path) -> None:
    assert observations
    printed = (folder / "second_install.txt").read_text(encoding="utf-8").splitlines()
    changes = [line for line in printed if line.startswith("would ")]
    # The installer always creates the symbolic link to the release, even if its target does not change.
    assert [line.endswith("switch current") for line in changes] == [True]


def test_uninstalling_with_purge_leaves_nothing(observations: dict[str, Any], folder: Path) -> None:
    assert observations
    assert (folder / "after_uninstall.txt").read_text(encoding="utf-8") == ""


def test_no_cgroup_and_no_mount_remains(observations: dict[str, Any]) -> None:
    assert observations
    assert not list(Path("/sys/fs/cgroup").glob("**/knightcube-test"))
    assert "/mnt/root" not in Path("/proc/self/mounts").read_text(encoding="utf-8")
