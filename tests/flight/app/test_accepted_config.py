"""Tests that a configuration with a wrong checksum is replaced by the last accepted configuration, if any."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import pytest

from flight.app.cli import main
from flight.app.flight import fly
from flight.app.run import RunRequest
from flight.app.service import (
    FOLDER,
    GOOD_START_NS,
    Chosen,
    FlownConfig,
    accepted_config,
    kept_configs,
    sum_file,
)
from flight.link.telemetry.packets import to_text
from flight.schema import reader as configuration
from flight.schema.bodies import as_testbed
from flight.schema.document import ConfigError, UnreadConfigError
from ground.telemetry import read_run
from sim_hal.faults.host import corrupted
from tests.hal.guardian.live_flight import write_config
from tests.manual_clock import ManualClock
from tests.support.flights import CONFIG

TESTBED = CONFIG.parent / "testbed.yaml"
TEXT = TESTBED.read_text(encoding="utf-8")


def accept(path: Path) -> None:
    """Write the checksum of a configuration as install.sh does."""
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
    """Return the environment of a service that has already accepted the testbed's configuration."""
    folder = tmp_path / "state"
    folder.mkdir()
    FlownConfig(TEXT, folder).keep()
    return {"STATE_DIRECTORY": str(folder)}


def texts_kept(folder: Path) -> list[str]:
    return [kept.text for kept in kept_configs(folder)]


def test_a_configuration_with_a_flipped_bit_is_never_flown(accepted: Path, service: dict[str, str]) -> None:
    for seed in range(40):
        accepted.write_text(corrupted(TEXT, 1, seed), encoding="utf-8")
        chosen = accepted_config(accepted, service)
        assert chosen.text == TEXT
        assert "differs from the accepted configuration" in chosen.problem


def test_a_flipped_bit_that_gives_another_valid_body_is_found_by_the_checksum(
    accepted: Path, service: dict[str, str]
) -> None:
    """The characters 3 and 7 differ by one bit.

    A flipped bit can change an inertia from 1.05e-3 to 1.05e-7.
    """
    assert ord("3") ^ ord("7") == 4
    accepted.write_text(TEXT.replace("1.05e-3", "1.05e-7", 1), encoding="utf-8")
    assert as_testbed(configuration.load(accepted)).plant.inertia == 1.05e-7
    flown = configuration.parse(accepted_config(accepted, service).text)
    assert as_testbed(flown).plant.inertia == 1.05e-3


def test_the_accepted_configuration_is_flown(accepted: Path, service: dict[str, str]) -> None:
    assert accepted_config(accepted, service) == Chosen(accepted, TEXT, "", True)
    assert accepted_config(accepted, {}) == Chosen(accepted, TEXT, "", True)


def test_without_a_checksum_a_file_is_used_unless_an_accepted_one_has_flown(
    tmp_path: Path, service: dict[str, str]
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("name: whatever", encoding="utf-8")
    assert accepted_config(path, {"STATE_DIRECTORY": str(tmp_path / "new")}) == Chosen(path, "name: whatever")
    chosen = accepted_config(path, service)
    assert chosen.text == TEXT
    assert "mine.yaml.sha256 is missing" in chosen.problem


@pytest.mark.parametrize("odd", ["dangling", "folder", "empty", "short", "text"])
def test_an_invalid_checksum_file_counts_as_damage(accepted: Path, service: dict[str, str], odd: str) -> None:
    beside = sum_file(accepted)
    line = beside.read_text(encoding="ascii")
    beside.unlink()
    if odd == "dangling":
        beside.symlink_to("nowhere")
    elif odd == "folder":
        beside.mkdir()
    else:
        beside.write_text({"empty": "", "short": line[:40], "text": "x" * 64}[odd], encoding="ascii")
    assert accepted_config(accepted, service).path.parent.name == FOLDER
    with pytest.raises(UnreadConfigError, match="no configuration of an earlier flight"):
        accepted_config(accepted, {})


def test_one_failed_read_does_not_count_as_damage(
    accepted: Path, service: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from flight.loop.state import LinuxFiles  # noqa: PLC0415

    read, calls = LinuxFiles.read, iter(range(100))

    def failing(files: LinuxFiles, path: Path) -> bytes | None:
        if next(calls) in (0, 2):
            raise OSError(5, "Input/output error")
        return read(files, path)

    monkeypatch.setattr(LinuxFiles, "read", failing)
    assert accepted_config(accepted, service) == Chosen(accepted, TEXT, "", True)


def test_without_a_flown_copy_a_damaged_configuration_is_refused_with_the_remedy(
    accepted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    accepted.write_text(TEXT.replace("1.05e-3", "1.05e-7"), encoding="utf-8")
    for environment in ({}, {"STATE_DIRECTORY": str(tmp_path / "empty")}):
        with pytest.raises(
            ConfigError, match=r"no configuration of an earlier flight is stored; .*install\.sh --accept"
        ):
            accepted_config(accepted, environment)
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    assert main(["run", str(accepted), "--out", str(tmp_path / "run")]) == 2
    assert "SHA-256" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_missing_or_damaged_configuration_is_replaced_by_the_newest_intact_copy(
    accepted: Path, service: dict[str, str]
) -> None:
    folder = Path(service["STATE_DIRECTORY"])
    for text in (TEXT + "# 2\n", TEXT + "# 3\n", TEXT + "# 4\n", TEXT + "# 5\n"):
        FlownConfig(text, folder).keep()
    assert texts_kept(folder) == [TEXT + "# 5\n", TEXT + "# 4\n", TEXT + "# 3\n"]
    accepted.unlink()
    sum_file(accepted).unlink()
    for number, wanted in enumerate(("# 5\n", "# 4\n", "# 3\n")):
        chosen = accepted_config(accepted, service)
        assert chosen.text == TEXT + wanted
        assert "no such file" in chosen.problem
        if number:
            chosen.path.write_text(chosen.text[:-3], encoding="utf-8")
        else:
            chosen.path.unlink()
            (chosen.path.parent / chosen.path.name.replace("5-", "9-")).write_bytes(b"name: other")
    with pytest.raises(UnreadConfigError, match="no configuration of an earlier flight"):
        accepted_config(accepted, service)


def test_a_stored_configuration_that_is_invalid_for_this_version_is_skipped(
    accepted: Path, service: dict[str, str]
) -> None:
    FlownConfig("name: of another version\n", Path(service["STATE_DIRECTORY"])).keep()
    accepted.unlink()
    assert accepted_config(accepted, service).text == TEXT


def test_a_configuration_is_kept_after_a_good_start_and_mended_where_it_was_damaged(tmp_path: Path) -> None:
    clock = ManualClock()
    FlownConfig(TEXT, tmp_path).serve(clock)
    clock.sleep_until_ns(clock.now_ns() + GOOD_START_NS - 1)
    assert not (tmp_path / FOLDER).exists()
    clock.sleep_until_ns(clock.now_ns() + 2)
    assert texts_kept(tmp_path) == [TEXT]
    (kept,) = kept_configs(tmp_path)
    kept.path.write_text("torn", encoding="utf-8")
    FlownConfig(TEXT, tmp_path).keep()
    (mended,) = kept_configs(tmp_path)
    assert mended.text == TEXT
    assert [path.name for path in (tmp_path / FOLDER).iterdir()] == [mended.path.name]
    before = mended.path.stat().st_ino
    FlownConfig(TEXT, tmp_path).keep()
    assert mended.path.stat().st_ino == before, "not written again where it is whole"
    FlownConfig(TEXT + "#", tmp_path).keep()
    FlownConfig(TEXT, tmp_path).keep()
    assert texts_kept(tmp_path) == [TEXT, TEXT + "#"], "what flies again is the newest again"


def test_a_crash_while_a_configuration_is_stored_leaves_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A crash at any change of the disk leaves the accepted configuration intact while another is stored."""
    FlownConfig(TEXT, tmp_path).keep()
    for name in ("open", "write", "fsync", "rename", "unlink"):
        folder = tmp_path.parent / f"{tmp_path.name}-{name}"
        shutil.copytree(tmp_path, folder)

        def crash(*_: object, **__: object) -> int:
            raise OSError(5, "crash")

        with monkeypatch.context() as patch:
            patch.setattr(f"flight.loop.state.os.{name}", crash)
            FlownConfig(TEXT + "#", folder).keep()
        assert TEXT in texts_kept(folder)
        FlownConfig(TEXT + "#", folder).keep()
        assert texts_kept(folder) == [TEXT + "#", TEXT]


def test_a_disk_that_fails_is_tried_again(tmp_path: Path) -> None:
    folder = tmp_path / "later"
    flown = FlownConfig(TEXT, folder)
    flown.keep()
    folder.mkdir()
    flown.keep()
    assert texts_kept(folder) == [TEXT]


def test_a_flight_of_a_stored_configuration_reports_it_as_an_event(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config, state = write_config(tmp_path), tmp_path / "state"
    state.mkdir()
    FlownConfig(config.read_text(encoding="utf-8"), state).keep()
    config.unlink()
    monkeypatch.setenv("STATE_DIRECTORY", str(state))
    request = RunRequest(config, tmp_path / "run", duration=1.0, accepted=True)
    fly(request)
    events = {to_text(row["name"]): to_text(row["text"]) for row in read_run(request.out)["event"]}
    assert "no such file" in events["config-damaged"]
    assert "the configuration of an earlier flight is used" in capsys.readouterr().err


def test_a_copy_that_cannot_be_read_now_is_not_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flight.loop.state import LinuxFiles  # noqa: PLC0415

    for text in (TEXT, TEXT + "# 2\n"):
        FlownConfig(text, tmp_path).keep()
    unread = kept_configs(tmp_path)[1].path
    read = LinuxFiles.read

    def failing(files: LinuxFiles, path: Path) -> bytes | None:
        if path == unread:
            raise OSError(5, "Input/output error")
        return read(files, path)

    with monkeypatch.context() as patch:
        patch.setattr(LinuxFiles, "read", failing)
        FlownConfig(TEXT + "# 3\n", tmp_path).keep()
        assert texts_kept(tmp_path) == [TEXT + "# 3\n", TEXT + "# 2\n"]
    assert texts_kept(tmp_path) == [TEXT + "# 3\n", TEXT + "# 2\n", TEXT]
