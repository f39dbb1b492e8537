"""A configuration that changed on the disk is not flown: the last that flew is, or nothing."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from flight.app.accepted_config import GOOD_START_NS, KEPT, FlownConfig, accepted_config, sum_file
from flight.app.cli import main
from flight.app.flight import fly
from flight.app.request import RunRequest
from flight.link.telemetry.packets import to_text
from flight.schema import reader as configuration
from flight.schema.errors import ConfigError
from flight.schema.testbed import as_testbed
from ground.telemetry.reader import read_run
from sim_hal.faults.host import corrupted
from tests.manual_clock import ManualClock
from tests.scenario.flights import CONFIG

TESTBED = CONFIG.parent / "testbed.yaml"
TEXT = TESTBED.read_text(encoding="utf-8")


def accept(path: Path) -> None:
    """Write the checksum as install.sh does."""
    line = f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n"
    sum_file(path).write_text(line, encoding="ascii")


@pytest.fixture
def accepted(tmp_path: Path) -> Path:
    path = tmp_path / "flight.yaml"
    path.write_text(TEXT, encoding="utf-8")
    accept(path)
    return path


@pytest.fixture
def service(tmp_path: Path) -> dict[str, str]:
    """Return the environment of a service that has flown the testbed's configuration before."""
    folder = tmp_path / "state"
    folder.mkdir()
    FlownConfig(TEXT, folder).keep()
    return {"STATE_DIRECTORY": str(folder)}


def test_no_single_bit_that_flips_is_flown(accepted: Path, service: dict[str, str]) -> None:
    for seed in range(300):
        accepted.write_text(corrupted(TEXT, 1, seed), encoding="utf-8")
        path, problem = accepted_config(accepted, service)
        assert path.read_text(encoding="utf-8") == TEXT
        assert "is not what was accepted" in problem


def test_a_flip_that_reads_as_another_body_is_found_by_the_checksum_alone(
    accepted: Path, service: dict[str, str]
) -> None:
    """The characters 3 and 7 are one bit apart."""
    assert ord("3") ^ ord("7") == 4
    accepted.write_text(TEXT.replace("1.05e-3", "1.05e-7", 1), encoding="utf-8")
    assert as_testbed(configuration.load(accepted)).plant.inertia == 1.05e-7
    assert as_testbed(configuration.load(accepted_config(accepted, service)[0])).plant.inertia == 1.05e-3


def test_what_was_accepted_is_flown(accepted: Path, service: dict[str, str]) -> None:
    assert accepted_config(accepted, service) == (accepted, "")
    assert accepted_config(accepted, {}) == (accepted, "")


def test_without_a_checksum_a_file_is_taken_as_it_stands(tmp_path: Path, service: dict[str, str]) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("name: whatever", encoding="utf-8")
    assert accepted_config(path, service) == (path, "")


def test_without_a_copy_that_flew_it_is_refused_with_the_cure(
    accepted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    accepted.write_text(TEXT.replace("1.05e-3", "1.05e-7"), encoding="utf-8")
    for environment in ({}, {"STATE_DIRECTORY": str(tmp_path / "empty")}):
        with pytest.raises(ConfigError, match=r"no copy of one that flew is kept; .*install\.sh --accept"):
            accepted_config(accepted, environment)
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    assert main(["run", str(accepted), "--out", str(tmp_path / "run")]) == 2
    assert "sha256" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("damage", [KEPT, f"{KEPT}.sha256"])
def test_a_copy_that_is_damaged_too_is_not_flown(
    accepted: Path, service: dict[str, str], damage: str
) -> None:
    accepted.write_text(TEXT + "\n", encoding="utf-8")
    path = Path(service["STATE_DIRECTORY"]) / damage
    for content in (path.read_text(encoding="utf-8").replace("0", "1"), "", None):
        if content is None:
            path.unlink()
        else:
            path.write_text(content, encoding="utf-8")
        with pytest.raises(ConfigError, match="no copy"):
            accepted_config(accepted, service)


def test_a_file_that_is_gone_is_replaced_by_the_one_that_flew(
    accepted: Path, service: dict[str, str]
) -> None:
    accepted.unlink()
    path, problem = accepted_config(accepted, service)
    assert path.name == KEPT
    assert "No such file" in problem


def test_a_configuration_is_kept_after_a_good_start_and_mended_where_it_was_damaged(tmp_path: Path) -> None:
    clock = ManualClock()
    kept = tmp_path / KEPT
    FlownConfig(TEXT, tmp_path).serve(clock)
    clock.sleep_until_ns(clock.now_ns() + GOOD_START_NS - 1)
    assert not kept.exists()
    clock.sleep_until_ns(clock.now_ns() + 2)
    assert kept.read_text(encoding="utf-8") == TEXT
    kept.write_text("torn", encoding="utf-8")
    FlownConfig(TEXT, tmp_path).keep()
    assert kept.read_text(encoding="utf-8") == TEXT
    before = kept.stat().st_ino
    FlownConfig(TEXT, tmp_path).keep()
    assert kept.stat().st_ino == before, "not written again where it is whole"


def test_a_disk_that_fails_is_tried_again(tmp_path: Path) -> None:
    folder = tmp_path / "later"
    flown = FlownConfig(TEXT, folder)
    flown.keep()
    folder.mkdir()
    flown.keep()
    assert accepted_config(folder / KEPT, {}) == (folder / KEPT, "")


def test_the_flight_of_a_kept_configuration_records_it_as_an_event(tmp_path: Path) -> None:
    request = RunRequest(CONFIG, tmp_path / "run", duration=2.0, config_problem="a bit has flipped")
    fly(request)
    events = {to_text(row["name"]): to_text(row["text"]) for row in read_run(request.out)["event"]}
    assert events["config-damaged"] == "a bit has flipped"


def test_the_command_line_flies_the_kept_one_and_says_so(
    accepted: Path, service: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requests: list[RunRequest] = []

    class Flown(Exception):
        """The flight would begin."""

    def take(request: RunRequest, _: object) -> None:
        requests.append(request)
        raise Flown

    monkeypatch.setattr("flight.app.flight.fly", take)
    monkeypatch.setenv("STATE_DIRECTORY", service["STATE_DIRECTORY"])
    accepted.write_text(TEXT + "\n", encoding="utf-8")
    with pytest.raises(Flown):
        main(["run", str(accepted), "--out", str(tmp_path / "run")])
    assert requests[0].config_path == Path(service["STATE_DIRECTORY"]) / KEPT
    assert "the last one that flew" in requests[0].config_problem
    assert accepted_config(requests[0].config_path, {}) == (requests[0].config_path, "")
