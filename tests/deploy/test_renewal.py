"""Tests of updates in orbit: a version that is not confirmed is replaced by the former version."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import shutil
import subprocess
import tarfile
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from flight.link.process.filing import decoded, encoded
from ground.commands.renewal import replace_signing_key
from tests.deploy.boards import FIRST
from tests.deploy.renewed_board import RenewedBoard, open_bundle, renewal
from tests.deploy.scripts import script

pytestmark = pytest.mark.skipif(
    shutil.which("systemctl") is None, reason="systemctl is missing: install systemd"
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> RenewedBoard:
    return RenewedBoard.make(tmp_path_factory.mktemp("made") / "board")


@pytest.fixture
def board(made: RenewedBoard, tmp_path: Path) -> RenewedBoard:
    return RenewedBoard.copy(made, tmp_path / "board")


def activated(board: RenewedBoard, name: str = "second", version: int = 1, hours: float = 1.0) -> str:
    """Activate a configuration; return the name of the request."""
    request = board.activate(board.bundle("configuration", board.changed(name), version), hours=hours)
    board.step()
    assert board.flown() == name, board.reports(request)
    return request


def test_a_confirmed_configuration_stays(board: RenewedBoard) -> None:
    board.processes = True
    before = board.flown()
    request = activated(board)
    assert [result for result, _ in board.reports(request)] == ["started"]
    assert board.restarted()
    board.request("confirm")
    board.step()
    assert board.reports(request)[-1] == ("completed", "configuration 1 is kept")
    board.step(1e6)
    assert board.flown() == "second"
    board.request("withdraw")
    board.step()
    assert board.flown() == before, "the version before is kept for the ground"


def test_an_unconfirmed_trial_ends_after_its_powered_time(board: RenewedBoard) -> None:
    before, request = board.flown(), activated(board, hours=1.0)
    board.step(3500.0)
    assert board.flown() == "second"
    board.now = 0.0  # after a reboot, the powered time restarts at zero
    board.step(60.0)
    assert board.flown() == "second"
    board.step(200.0)
    assert board.flown() == before
    assert board.reports(request)[-1][0] == "failed"
    assert "did not confirm" in board.reports(request)[-1][1]
    board.request("confirm")
    board.step()
    assert board.flown() == before, "too late"


@pytest.mark.parametrize("unit", ["knightcube.service", "knightcube-link.service"])
def test_a_unit_that_does_not_start_ends_the_trial(board: RenewedBoard, unit: str) -> None:
    before, request = board.flown(), activated(board)
    board.set_active(unit, False)
    board.step(100.0)
    assert board.flown() == "second", "it may still come"
    board.step(100.0)
    assert board.flown() == before
    assert "did not run for 180 s" in board.reports(request)[-1][1]


def test_nothing_is_confirmed_while_the_flight_is_down(board: RenewedBoard) -> None:
    before = board.flown()
    activated(board)
    board.set_active("knightcube.service", False)
    refused = board.request("confirm")
    board.step()
    assert board.reports(refused)[-1][0] == "failed"
    board.step(200.0)
    assert board.flown() == before


def test_the_safe_state_ends_the_trial_at_once(board: RenewedBoard) -> None:
    before = board.flown()
    activated(board)
    board.set_active("knightcube-safe.service", True)
    board.step()
    assert board.flown() == before


@pytest.mark.parametrize(
    ("part", "call"),
    [
        ("flight", "--no-block restart knightcube.service"),
        ("link", "--no-block restart knightcube-link.service"),
        ("board", "--no-block reboot"),
    ],
)
def test_a_part_is_restarted_once_by_command(board: RenewedBoard, part: str, call: str) -> None:
    name = board.request("restart", part=part)
    for _ in range(3):
        board.step()
        board.run("--restart")
    assert (board.place / "calls").read_text(encoding="ascii").splitlines().count(call) == 1
    reports = decoded((board.own / "status").read_bytes())["reports"]
    assert [report[1:4] for report in reports] == [[name, "completed", "restart"]]


def test_requests_are_executed_in_the_order_of_their_counters(board: RenewedBoard) -> None:
    board.count = 8
    names = [board.request("restart", part="unknown") for _ in range(3)]
    for _ in names:
        board.step()
    reports = decoded((board.own / "status").read_bytes())["reports"]
    assert [report[1] for report in reports] == names == ["1-9-0-0", "1-10-0-0", "1-11-0-0"]


@pytest.mark.parametrize(
    ("part", "unit"), [("flight", "knightcube.service"), ("link", "knightcube-link.service")]
)
def test_a_killed_restart_is_repeated(board: RenewedBoard, part: str, unit: str) -> None:
    _kill_the_next_restart(board, part)
    board.run("--restart")
    calls = (board.place / "calls").read_text(encoding="ascii").splitlines()
    assert calls.count(f"--no-block restart {unit}") == 1


def test_a_killed_reboot_is_not_repeated_after_the_boot(board: RenewedBoard) -> None:
    _kill_the_next_restart(board, "board")
    board.run("--restart")
    assert not (board.place / "calls").exists()


def _kill_the_next_restart(board: RenewedBoard, part: str) -> None:
    """Request a restart, and kill the program at its first call of systemctl."""
    board.request("restart", part=part)
    board.step()
    _kill_at(board, "systemctl", "--restart")


def _kill_at(board: RenewedBoard, name: str, *options: str) -> None:
    """Run the privileged program, and kill it at its first call of another program."""
    program = board.place / "bin" / name
    text = program.read_text(encoding="ascii")
    program.write_text("#!/bin/sh\nkill -9 $PPID\n", encoding="ascii")
    done = subprocess.run([*board.words(), *options], env=board.environment(), check=False)
    assert done.returncode == -9
    program.write_text(text, encoding="ascii")


@pytest.mark.parametrize("content", [b"", b"flighu link", b"\xe6light link", b"\0" * 11])
def test_a_damaged_request_restarts_flight_and_link(board: RenewedBoard, content: bytes) -> None:
    (board.own / "restart").write_bytes(content)
    board.run("--restart")
    calls = (board.place / "calls").read_text(encoding="ascii").splitlines()
    assert [call for call in calls if "--no-block" in call] == [
        "--no-block restart knightcube.service",
        "--no-block restart knightcube-link.service",
    ]
    assert not board.restarted()


@pytest.mark.parametrize("part", ["", "knightcube.service", "--root=/", "Board"])
def test_an_unknown_part_is_not_restarted(board: RenewedBoard, part: str) -> None:
    board.request("restart", part=part)
    assert "renewal: restart failed: the request is damaged" in board.step()
    calls = board.place / "calls"
    assert not calls.exists() or "restart" not in calls.read_text(encoding="ascii")


def test_a_board_in_its_safe_state_can_be_renewed(board: RenewedBoard) -> None:
    board.set_active("knightcube-safe.service", True)
    activated(board)
    board.set_active("knightcube-safe.service", False)
    board.step()
    assert board.flown() == "second"


def test_a_fault_ends_the_trial_unless_it_was_permitted(board: RenewedBoard) -> None:
    before = board.flown()
    board.contact(1, "a", fault="an old one")
    activated(board)
    board.step()
    assert board.flown() == "second", "the link of before reported it"
    board.contact(0, "b", fault="coil 2 is open")
    board.step()
    assert board.flown() == before
    bundle = board.bundle("configuration", board.changed("third"), 2)
    board.activate(bundle, despite_faults=True)
    board.step()
    board.contact(0, "c", fault="coil 2 is open")
    board.step()
    assert board.flown() == "third"


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        ("byte", "is not the file that was activated"),
        ("cut", "damaged"),
        ("foreign key", "UnsignedMetadataError"),
        ("invalid", "`coils.bus`"),
        ("no link", "contact would be lost"),
        ("extends", "`extends` cannot be used on a board"),
    ],
)
def test_bundles_that_are_damaged_unsigned_or_invalid_are_refused(
    board: RenewedBoard, damage: str, words: str
) -> None:
    before, path = board.flown(), board.changed("second")
    if damage == "invalid":
        path.write_text(path.read_text().replace("  bus: 1", "  bus: -1"))
    if damage == "no link":
        path.write_text("".join(line for line in path.read_text().splitlines(True) if "link:" not in line))
    if damage == "extends":
        path.write_text("extends: testbed\n")
    if damage == "foreign key":
        shutil.rmtree(board.place / "signing")
        from ground.commands.renewal import make_signing_keys  # noqa: PLC0415

        make_signing_keys(board.place / "signing")
    bundle = board.bundle("configuration", path, 1, unchecked=True)
    if damage == "cut":
        bundle.write_bytes(bundle.read_bytes()[:-200])
    request = board.activate(bundle)
    if damage == "byte":
        placed = board.link / "files/chosen/configuration" / bundle.name
        data = bytearray(placed.read_bytes())
        data[100] ^= 1
        placed.write_bytes(data)
    board.step()
    result, text = board.reports(request)[-1]
    assert (result, words in text) == ("failed", True), text
    assert board.flown() == before


def test_versions_decrease_only_with_a_signature_that_permits_it(board: RenewedBoard) -> None:
    first = board.bundle("configuration", board.changed("first"), 1)
    board.activate(first)
    board.step()
    board.request("confirm")
    board.step()
    second = board.bundle("configuration", board.changed("second"), 2)
    board.activate(second)
    board.step()
    board.request("confirm")
    board.step()
    replayed = board.activate(first)
    board.step()
    assert "BadVersionNumberError" in board.reports(replayed)[-1][1]
    assert board.flown() == "second"
    again = board.activate(board.bundle("configuration", board.changed("first"), 1, back=True))
    board.step()
    assert board.flown() == "first", board.reports(again)


def test_an_old_key_is_refused_once_a_root_key_has_named_another(board: RenewedBoard) -> None:
    stolen = board.place / "stolen"
    shutil.copytree(board.place / "signing", stolen)
    assert replace_signing_key(board.place / "signing", also_root=False) == 2
    activated(board)
    board.request("confirm")
    board.step()
    shutil.rmtree(board.place / "signing")
    stolen.rename(board.place / "signing")
    request = board.activate(board.bundle("configuration", board.changed("third"), 9, least=99))
    board.step()
    assert board.reports(request)[-1][0] == "failed"
    assert board.flown() == "second"


def test_the_expiry_of_a_signature_is_the_signers_choice(board: RenewedBoard) -> None:
    end = datetime.now(UTC) + timedelta(days=300)
    before, after = (round((end + timedelta(days=days)).timestamp()) for days in (-3, 3))
    bundle = board.bundle("configuration", board.changed("second"), 1, expires=end.date().isoformat())
    request = board.activate(bundle, utc=after)
    board.step()
    assert "ExpiredMetadataError" in board.reports(request)[-1][1], "the system clock is before the end"
    request = board.activate(bundle, utc=before)
    board.step()
    assert board.reports(request)[-1][0] == "started"


def test_a_wrong_system_clock_rejects_no_signature_while_the_mission_time_is_unknown(
    board: RenewedBoard,
) -> None:
    bundle = board.bundle("configuration", board.changed("second"), 1, expires="2020-01-01")
    for utc in ("soon", 10**11):
        request = board.activate(bundle, utc=utc)
        board.step()
        assert board.reports(request)[-1][0] == "failed"
    request = board.activate(bundle)
    board.step()
    assert board.reports(request)[-1][0] == "started"


ELEMENTS = (
    "1 25544U 98067A   08264.51782528 -.00002182  00000-0 -11606-4 0  2927",
    "2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.72125391563537",
)


def test_elements_replace_one_value_of_the_present_configuration(board: RenewedBoard) -> None:
    text = board.config.read_text() + f"elements:\n  - '{ELEMENTS[1]}'\n  - 'x'\n\n# after\nlast: 1\n"
    open_bundle = script("open_bundle")
    changed = open_bundle.replaced(text, ("elements",), json.dumps(ELEMENTS))
    assert changed.endswith(f"elements:\n   {json.dumps(ELEMENTS)}\n\n# after\nlast: 1\n")
    path = board.place / "elements.txt"
    path.write_text("\n".join(ELEMENTS) + "\n")
    request = board.activate(board.bundle("elements", path, 1), "elements")
    board.step()
    assert "has no `elements`" in board.reports(request)[-1][1], "a testbed has none"


def test_a_damaged_configuration_is_not_accepted_with_new_elements(board: RenewedBoard) -> None:
    """A damaged configuration that is stored with new elements would get a valid checksum."""
    board.config.write_text(board.config.read_text().replace("duration: ", "duration: 1"))
    path = board.place / "elements.txt"
    path.write_text("\n".join(ELEMENTS) + "\n")
    request = board.activate(board.bundle("elements", path, 1), "elements")
    board.step()
    assert "the present configuration is damaged" in board.reports(request)[-1][1]


def test_a_release_is_built_from_the_packages_of_the_present_one_and_tried(board: RenewedBoard) -> None:
    board.processes = True
    assert board.release() == "old"
    request = board.activate(board.bundle("release", board.source("new"), 1), "release")
    board.step()
    assert board.release() == "new", board.reports(request)
    board.request("confirm", "release")
    board.step()
    assert board.reports(request)[-1][0] == "completed"
    board.request("withdraw", "release")
    board.step()
    assert board.release() == "old"


@contextlib.contextmanager
def running_the_old_release(board: RenewedBoard, unit: str) -> Iterator[None]:
    """Make a unit run the release that was installed first."""
    place = board.files.prefix / "releases" / FIRST / "venv/bin/python"
    with subprocess.Popen([str(place), "60"], executable="/bin/sleep") as process:
        (board.place / f"pid-{unit}").write_text(f"{process.pid}\n", encoding="ascii")
        yield
        process.kill()


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="setpriv is missing: install util-linux")
@pytest.mark.parametrize(
    ("path", "mode"),
    [
        ("etc/knightcube", 0o555),
        ("etc/knightcube/flight.yaml", 0),
        ("var/lib/knightcube-renewal", 0o555),
        ("var/lib/knightcube-renewal", 0),
        ("var/lib/knightcube-link", 0),
        ("opt/knightcube/releases", 0),
    ],
)
def test_a_trial_ends_although_files_deny_access_at_its_end(
    board: RenewedBoard, path: str, mode: int
) -> None:
    """When the trial is over, even root is denied access, and the next run completes the return.

    Without the two capabilities, the permissions of the owner apply to root.
    """
    activated(board)
    board.now += 3600.0
    limits = [f"--{kind}=-dac_override,-dac_read_search" for kind in ("bounding-set", "inh-caps")]
    words = ["setpriv", *(limits if os.geteuid() == 0 else ["--no-new-privs"]), *board.words()]
    denied = board.root / path
    before = denied.stat().st_mode
    denied.chmod(mode)
    try:
        done = subprocess.run(words, env=board.environment(), capture_output=True, text=True, check=False)
    finally:
        denied.chmod(before)
    assert "Traceback" not in done.stderr
    assert done.returncode == 0 or done.stderr.startswith("renewal: [Errno 13] Permission denied")
    board.step()
    assert board.flown() == "testbed"


@pytest.mark.parametrize("unit", ["knightcube.service", "knightcube-link.service"])
def test_a_trial_ends_if_flight_or_link_run_another_release(board: RenewedBoard, unit: str) -> None:
    request = board.activate(board.bundle("release", board.source("new"), 1), "release")
    board.step()
    confirmed = board.request("confirm", "release")
    with running_the_old_release(board, unit):
        board.step()
    assert board.release() == "old"
    assert board.reports(confirmed)[-1] == ("failed", f"flight or link runs release {FIRST} instead")
    result, text = board.reports(request)[-1]
    assert (result, f"runs release {FIRST} instead" in text) == ("failed", True), text


def test_a_trial_begins_when_the_release_is_built_even_after_a_kill(board: RenewedBoard) -> None:
    request = board.activate(board.bundle("release", board.source("new"), 1), "release")
    _kill_at(board, "python3")
    assert not (board.own / "status").exists() or not board.reports(request)
    with running_the_old_release(board, "knightcube.service"):  # the unit restarts after the step
        board.step()
    assert board.release() == "new"
    assert [result for result, _ in board.reports(request)] == ["started"]


def test_a_request_during_which_the_program_is_killed_is_executed_three_times(board: RenewedBoard) -> None:
    """A bundle whose check resets the board would otherwise reset the board again after each boot."""
    request = board.activate(board.bundle("configuration", board.changed("second"), 1))
    with patch.object(renewal.Renewal, "_copy_bundle", side_effect=KeyboardInterrupt) as checked:
        for _ in range(renewal.MOST_TRIES):
            with pytest.raises(KeyboardInterrupt):
                board.step()
        board.step()
    assert checked.call_count == renewal.MOST_TRIES
    assert board.reports(request) == [
        ("failed", "the board or the renewal program stopped 3 times during this request")
    ]
    activated(board, version=2)


def test_a_request_after_a_new_key_may_have_the_name_of_an_earlier_request(board: RenewedBoard) -> None:
    """The frame counters of a new key begin at 0."""
    for step in range(3):
        board.count = 0
        board.request("restart", part="flight")
        board.step()
        board.step()
        assert len(board.reports("1-1-0-0")) == step + 1


def test_a_refused_bundle_leaves_no_files(board: RenewedBoard) -> None:
    """The files of a bundle that fills the disk would prevent the storage of its refusal."""
    bundle = board.bundle("configuration", board.changed("second"), 1)
    bundle.write_bytes(bundle.read_bytes()[:-100])
    request = board.activate(bundle)
    board.step()
    assert board.reports(request)[-1][0] == "failed"
    assert not (board.own / "staging").exists()


def test_a_release_that_cannot_open_bundles_is_refused(board: RenewedBoard) -> None:
    """If neither release of a board could open bundles, the board could never be updated again."""
    opened = open_bundle.main

    def main(words: Sequence[str]) -> int:
        return opened(words) if Path(words[0]) == board.own / "trusted" else 1

    request = board.activate(board.bundle("release", board.source("new"), 1), "release")
    with patch.object(open_bundle, "main", main):
        board.step()
    result, text = board.reports(request)[-1]
    assert (result, "the release cannot open bundles" in text) == ("failed", True), text
    assert board.release() == "old"
    assert [path.name for path in (board.files.prefix / "releases").iterdir()] == [FIRST]


def test_a_release_that_cannot_be_checked_on_a_full_disk_leaves_no_files(board: RenewedBoard) -> None:
    request = board.activate(board.bundle("release", board.source("new"), 1), "release")
    full = OSError(errno.ENOSPC, "No space left on device")
    with patch.object(renewal.Renewal, "_check_built", side_effect=full):
        board.step()
    assert "No space left on device" in board.reports(request)[-1][1]
    assert [path.name for path in (board.files.prefix / "releases").iterdir()] == [FIRST]


def test_the_check_of_a_built_release_has_the_space_of_its_unpacked_bundle(board: RenewedBoard) -> None:
    check, found = renewal.Renewal._check_built, list[str]()

    def checked(renewing: Any, name: str) -> None:
        found.extend(path.name for path in (board.own / "staging").iterdir())
        check(renewing, name)

    board.activate(board.bundle("release", board.source("new"), 1), "release")
    with patch.object(renewal.Renewal, "_check_built", checked):
        board.step()
    assert board.release() == "new"
    assert sorted(found) == ["bundle", "source"]


def test_a_release_is_not_built_from_damaged_packages(board: RenewedBoard) -> None:
    (library,) = (board.files.prefix / "current").glob("venv/lib/python3*/site-packages/numpy/numpy.py")
    library.write_text(library.read_text(encoding="ascii").upper(), encoding="ascii")
    request = board.activate(board.bundle("release", board.source("new"), 1), "release")
    board.step()
    assert not board.restarted()  # the flight is not restarted
    assert board.release() == "old"
    result, text = board.reports(request)[-1]
    assert (result, "add the folder wheels, because venv/lib" in text) == ("failed", True), text


def test_a_release_replaces_one_whose_own_files_or_bytecode_are_damaged(board: RenewedBoard) -> None:
    current = board.files.prefix / "current"
    (site,) = current.glob("venv/lib/python3*/site-packages")
    cache = site / "__pycache__/numpy.cpython-311.pyc"
    cache.parent.mkdir()
    cache.write_bytes(b"bytecode")
    manifest = script("releases").manifest_text(current.resolve())
    (current / "manifest").write_text(manifest, encoding="utf-8")
    cache.write_bytes(b"other bytes")
    (site / "flight/label").write_text("OLD", encoding="ascii")
    request = board.activate(board.bundle("release", board.source("new"), 1), "release")
    board.step()
    assert board.release() == "new", board.reports(request)
    assert not list((board.files.prefix / "current").glob("venv/lib/python3*/site-packages/__pycache__"))


@pytest.mark.parametrize("file", ["source", "manifest"])
def test_a_bad_byte_in_the_records_of_the_current_release_stops_no_program(
    board: RenewedBoard, file: str
) -> None:
    """Without a manifest the packages must be in the bundle; the record of the sources is not needed."""
    record = board.files.prefix / "current" / file
    record.write_bytes(b"\xff" + record.read_bytes()[1:])
    request = board.activate(board.bundle("release", board.source("new"), 1), "release")
    board.step()
    result, text = board.reports(request)[-1]
    if file == "source":
        assert (result, board.release()) == ("started", "new"), text
    else:
        assert (result, "add the folder wheels" in text) == ("failed", True), text


def test_a_trial_that_fails_after_damage_to_the_current_release_ends_with_the_release_that_ran_before(
    board: RenewedBoard,
) -> None:
    board.activate(board.bundle("release", board.source("new"), 1), "release")
    board.step()
    board.request("confirm", "release")
    board.step()
    (board.files.prefix / "current/manifest").unlink()
    assert board.release() == "old"
    request = board.activate(board.bundle("release", board.source("newest"), 2), "release")
    board.step()
    assert board.release() == "newest", board.reports(request)
    assert (board.files.prefix / "previous").readlink() == Path("releases") / FIRST
    board.step(4000.0)
    assert board.reports(request)[-1][0] == "failed"
    assert board.release() == "old"


def test_a_trial_ends_although_its_reports_cannot_be_written(board: RenewedBoard) -> None:
    before = board.flown()
    activated(board)
    (board.own / "status").unlink()
    (board.own / "status").mkdir()
    complaints = board.step(4000.0)
    assert board.flown() == before
    assert "cannot write the status" in complaints
    (board.own / "status").rmdir()
    board.step()
    status = decoded((board.own / "status").read_bytes())
    assert "did not confirm" in status["reports"][-1][-1]


@pytest.mark.parametrize("damage", ["flip", "empty", "missing"])
def test_damaged_trusted_metadata_do_not_prevent_a_renewal(board: RenewedBoard, damage: str) -> None:
    activated(board)
    board.request("confirm")
    board.step()
    for path in sorted((board.own / "trusted").rglob("*.json")):
        if path.is_symlink():
            continue
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.unlink() if damage == "missing" else path.write_bytes(data if damage == "flip" else b"")
    activated(board, "third", 2)


def test_releases_that_fail_their_trials_do_not_fill_the_disk(board: RenewedBoard) -> None:
    """The newest one stays, because the script `fly` starts it if all other releases are damaged."""
    releases = board.files.prefix / "releases"
    for number, label in enumerate(("one", "two", "three"), start=1):
        board.activate(board.bundle("release", board.source(label), number), "release")
        board.step()
        board.request("withdraw", "release")
        board.step()
        board.step()
        labels = {(path / "label").read_text(encoding="ascii") for path in releases.glob("*/venv")}
        assert labels == {"old", label}


def test_a_catalogue_that_fails_its_trial_does_not_stay_on_the_disk(board: RenewedBoard) -> None:
    kept = board.own / "kept"
    activated(board)
    (kept / "index-0").write_bytes(b"catalogue")
    board.request("withdraw")
    board.step()
    assert {path.name for path in kept.iterdir()} <= {
        "ground",
        decoded((board.own / "state.a").read_bytes())["previous"],
    }


def test_a_release_that_fails_its_trial_is_never_returned_to(board: RenewedBoard) -> None:
    board.activate(board.bundle("release", board.source("new"), 1), "release")
    board.step()
    board.set_active("knightcube.service", False)
    board.step(200.0)
    assert board.release() == "old"
    refused = board.request("withdraw", "release")
    board.step()
    assert board.reports(refused)[-1] == ("failed", "there is no previous release")
    assert board.release() == "old"


def test_without_contact_the_board_returns_to_earlier_versions_one_after_another(board: RenewedBoard) -> None:
    ground = board.flown()
    for number, name in enumerate(("first", "second"), start=1):
        activated(board, name, number)
        board.request("confirm")
        board.step()
    board.activate(board.bundle("release", board.source("new"), 1), "release")
    board.step()
    board.request("confirm", "release")
    board.contact(7, limit_s=86_400.0)
    board.step()
    board.step(80_000.0)
    board.now = 0.0  # a reboot does not change the time
    board.step(7_000.0)
    assert (board.release(), board.flown()) == ("old", "second")
    board.step(86_500.0)
    assert (board.release(), board.flown()) == ("old", "first")
    board.step(86_500.0)
    assert (board.release(), board.flown()) == ("old", ground)
    texts = [text for _, text in board.reports("")]
    assert [text.partition(" the ")[2] for text in texts] == [
        "previous release is used",
        "previous configuration is used",
        "configuration accepted on the ground is used",
    ]
    board.step(1e6)
    assert len(board.reports("")) == 3
    board.contact(8, limit_s=86_400.0)
    board.step()
    board.step(80_000.0)
    assert len(board.reports("")) == 3


def test_without_a_limit_and_with_authentic_frames_nothing_happens(board: RenewedBoard) -> None:
    activated(board)
    board.request("confirm")
    board.contact(1)
    board.step()
    board.step(1e8)
    board.contact(1, limit_s=1000.0)
    for frames in range(2, 8):
        board.contact(frames, limit_s=1000.0)
        board.step(900.0)
    assert board.reports("") == []
    board.contact(0, "another session", limit_s=1000.0)
    board.step(1100.0)
    assert board.flown() != "second", "a new link without a frame is silence"


@pytest.mark.parametrize("kind", ["fifo", "link", "folder", "large", "text"])
def test_a_request_that_is_not_a_small_regular_file_is_refused(board: RenewedBoard, kind: str) -> None:
    path = board.link / "renewal/1-5-0-0"
    if kind == "fifo":
        import os  # noqa: PLC0415

        os.mkfifo(path)
    elif kind == "link":
        path.symlink_to("/etc/passwd")
    elif kind == "folder":
        path.mkdir()
    else:
        path.write_bytes(b"{" * (1 << 20 if kind == "large" else 9))
    board.step()
    assert board.reports("1-5-0-0") == [("failed", "the request is damaged")]


@pytest.mark.parametrize("copies", ["a", "b", "ab"])
def test_the_state_survives_damage_to_one_of_its_copies(board: RenewedBoard, copies: str) -> None:
    before = board.flown()
    activated(board)
    for copy in copies:
        path = board.own / f"state.{copy}"
        data = bytearray(path.read_bytes())
        data[len(data) // 3] ^= 4
        path.write_bytes(data)
    board.step(4000.0)
    assert board.flown() == (before if len(copies) == 1 else "second"), "without any record the trial is lost"


@pytest.mark.parametrize("part", ["state", "trial"])
def test_a_record_of_a_later_version_keeps_the_trial(board: RenewedBoard, part: str) -> None:
    """An earlier version of the program ignores the values that it does not know."""
    before = board.flown()
    activated(board)
    for path in board.own.glob("state.?"):
        values = decoded(path.read_bytes())
        (values if part == "state" else values["trial"])["later"] = [1]
        path.write_bytes(encoded(values))
    board.step(4000.0)
    assert board.flown() == before


def test_an_accepted_configuration_is_not_replaced_at_the_end_of_a_trial(board: RenewedBoard) -> None:
    before, request = board.flown(), activated(board)
    board.run("--accepted", "configuration")
    board.step(4000.0)
    assert board.flown() == "second"
    assert board.reports(request)[-1] == (
        "failed",
        "install.sh was run: the version that it installed is kept",
    )
    board.request("withdraw")
    board.step()
    assert board.flown() == before, "the configuration before the trial is kept for the ground"


@pytest.mark.parametrize(
    ("accepted", "stays", "stored"),
    [("release", "third", ["first", "third"]), ("configuration", "first", ["first", "old", "second"])],
)
def test_a_trial_is_ended_by_an_installation_but_not_by_an_accepted_configuration(
    board: RenewedBoard, accepted: str, stays: str, stored: list[str]
) -> None:
    """The fallback of an installed release is the confirmed release, not the release on trial."""
    board.files.install("first")
    board.activate(board.bundle("release", board.source("second"), 1), "release")
    board.step()
    assert board.release() == "second"
    if accepted == "release":
        board.files.install("third")
    else:
        board.run("--accepted", accepted)
    board.step(4000.0)
    assert board.release() == stays
    labels = [path.read_text() for path in board.files.prefix.glob("releases/*/venv/**/flight/label")]
    assert sorted(labels) == stored


def test_an_accepted_configuration_does_not_end_a_return_to_the_earlier_release(
    board: RenewedBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    board.files.install("first")
    board.files.install("second")
    request = board.request("withdraw", "release")
    first = Path("releases") / (board.files.prefix / "previous").readlink().name
    _fail_once(monkeypatch, renewal.os, "symlink", first)
    board.step()
    board.run("--accepted", "configuration")
    assert board.release() == "second"
    board.step()
    assert board.release() == "first"
    assert board.reports(request)[-1][0] == "completed"


def test_one_failed_read_loses_no_state(board: RenewedBoard, monkeypatch: pytest.MonkeyPatch) -> None:
    before = board.flown()
    activated(board)
    _fail_once(monkeypatch, renewal, "open_beneath", ["state.a"], ["state.b"])
    board.step(4000.0)
    assert board.flown() == before


def test_one_failed_read_of_the_old_configuration_does_not_lead_to_that_of_the_ground(
    board: RenewedBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    activated(board, "first")
    board.request("confirm")
    board.step()
    activated(board, "second", 2)
    kept = decoded((board.own / "state.a").read_bytes())["trial"]["old"]
    _fail_once(monkeypatch, Path, "read_bytes", board.own / "kept" / kept / "sums")
    board.step(4000.0)
    assert board.flown() == "first"


def test_one_failed_read_deletes_no_release(board: RenewedBoard, monkeypatch: pytest.MonkeyPatch) -> None:
    board.activate(board.bundle("release", board.source("new"), 1), "release")
    board.step()
    request = board.request("confirm", "release")
    _fail_once(monkeypatch, renewal.os, "readlink", board.files.prefix / "previous")
    board.step()
    assert board.reports(request)[-1][0] == "completed"
    assert len(list((board.files.prefix / "releases").iterdir())) == 2


def _fail_once(monkeypatch: pytest.MonkeyPatch, owner: object, name: str, *wanted: object) -> None:
    """Let the first call of a function with each of the arguments `wanted` fail."""
    call, left = getattr(owner, name), list(wanted)

    def fail(*arguments: Any) -> Any:
        for one in arguments:
            if one in left:
                left.remove(one)
                raise OSError(5, "Input/output error")
        return call(*arguments)

    monkeypatch.setattr(owner, name, fail)


def _confirmed_with_contact(board: RenewedBoard) -> str:
    """Confirm a new configuration with a contact limit of 1,000 s; return the previous configuration."""
    before = board.flown()
    activated(board)
    board.request("confirm")
    board.contact(7, limit_s=1000.0)
    board.step()
    return before


@pytest.mark.parametrize("damage", ["missing", "bad sector"])
def test_without_contact_the_board_leaves_a_configuration_that_cannot_be_read(
    board: RenewedBoard, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ground = _confirmed_with_contact(board)
    read, damaged = Path.read_bytes, board.config.stat().st_ino

    def fail(path: Path) -> bytes:
        if path == board.config and path.stat().st_ino == damaged:
            raise OSError(5, "Input/output error")
        return read(path)

    if damage == "missing":
        board.config.unlink()
    else:
        monkeypatch.setattr(Path, "read_bytes", fail)
    for _ in range(3):
        board.step(1100.0)
    assert board.flown() == ground


def test_without_contact_the_board_returns_although_the_present_configuration_cannot_be_stored(
    board: RenewedBoard,
) -> None:
    ground = _confirmed_with_contact(board)
    with patch.object(renewal.Board, "keep", side_effect=OSError(5, "Input/output error")):
        for _ in range(3):
            board.step(1100.0)
    assert board.flown() == ground


def test_a_configuration_that_cannot_be_read_can_be_replaced(board: RenewedBoard) -> None:
    ground, path = board.flown(), board.changed("second")
    board.config.unlink()
    request = board.activate(board.bundle("configuration", path, 1))
    board.step()
    assert board.flown() == "second", board.reports(request)
    board.step(4000.0)
    assert board.flown() == ground


def test_a_return_that_fails_is_tried_again_and_blocks_no_request(board: RenewedBoard) -> None:
    ground = board.flown()
    activated(board)
    board.request("confirm")
    board.step()
    board.config.unlink()
    board.config.mkdir()
    (board.config / "file").touch()
    withdrawn = board.request("withdraw")
    board.step()
    refused = board.activate(board.bundle("configuration", board.place / "second.yaml", 2))
    assert "cannot return yet" in board.step()
    assert board.reports(refused) == [
        ("failed", "the return to an earlier version is not finished: activate again later")
    ]
    shutil.rmtree(board.config)
    board.step()
    assert board.flown() == ground
    assert board.reports(withdrawn)[-1][0] == "completed"


@pytest.mark.parametrize("word", ["activate", "confirm", "withdraw"])
def test_a_request_that_cannot_be_stored_is_reported_as_failed_and_not_executed_later(
    board: RenewedBoard, word: str
) -> None:
    began = activated(board)
    if word != "confirm":
        board.request("confirm")
        board.step()
    third = board.bundle("configuration", board.changed("third"), 2)
    request = board.activate(third) if word == "activate" else board.request(word)
    save, fails = renewal.Renewal._save, iter([False, True])

    def saved(step: Any) -> None:
        if next(fails, False):
            raise OSError(28, "No space left on device")
        save(step)

    with patch.object(renewal.Renewal, "_save", saved):
        board.step()
    board.step()
    assert [result for result, _ in board.reports(request)] == ["failed"]
    assert board.flown() == "second"
    assert board.reports(began)[-1][0] == ("started" if word == "confirm" else "completed")


def test_a_trial_ends_although_no_stored_configuration_is_intact(board: RenewedBoard) -> None:
    request = activated(board)
    shutil.rmtree(board.own / "kept")
    board.step(4000.0)
    assert board.reports(request)[-1][0] == "failed"
    assert board.flown() == "second"
    activated(board, "third", 2)


def test_the_time_of_a_build_does_not_end_the_trial(board: RenewedBoard) -> None:
    """After the build, flight and link restart, so they do not run yet at the next step."""
    before = board.flown()
    board.activate(board.bundle("configuration", board.changed("second"), 1))
    times = [board.now + 10.0, board.now + 1800.0]
    monotonic = renewal.Renewal.__init__

    def begin(step: Any, place: Any, _: object, boot: str) -> None:
        monotonic(step, place, lambda: times.pop(0), boot)

    with patch.object(renewal.Renewal, "__init__", begin):
        board.step()
    assert (board.flown(), times) == ("second", [])
    board.set_active("knightcube.service", False)
    board.now += 1800.0
    board.step(10.0)
    assert board.flown() == "second"
    board.step(200.0)
    assert board.flown() == before


def test_restarts_of_one_step_are_all_executed(board: RenewedBoard) -> None:
    activated(board)
    board.request("restart", part="link")
    board.step()
    board.run("--restart")
    calls = (board.place / "calls").read_text(encoding="ascii").splitlines()
    assert [call for call in calls if "--no-block" in call] == [
        "--no-block restart knightcube-link.service",
        "--no-block restart knightcube.service",
    ]


def test_long_texts_of_the_link_lose_no_state(board: RenewedBoard) -> None:
    before, request = board.flown(), activated(board)
    board.request("x" * 60_000)
    board.contact(0, "s" * 20_000, fault="f" * 40_000)
    board.step()
    board.step()
    assert board.flown() == before
    assert "the flight reported a fault: fff" in board.reports(request)[-1][1]


def test_a_copy_that_cannot_be_stored_leaves_the_earlier_copy(
    board: RenewedBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = renewal.Board(board.root)
    before = place.stored("ground")
    board.config.write_text(board.changed("second").read_text(encoding="utf-8"), encoding="utf-8")
    _fail_once(monkeypatch, renewal.os, "fsync", *range(3, 100))
    with pytest.raises(OSError, match="Input/output"):
        place.keep("ground")
    assert before is not None
    assert place.stored("ground") == before


@pytest.mark.parametrize("name", [".index-0.part", "index-0", ".0.part/flight.yaml", "0/flight.yaml"])
def test_what_an_interrupted_step_left_is_removed_after_a_confirmed_trial(
    board: RenewedBoard, name: str
) -> None:
    activated(board)
    left = board.own / "kept" / name
    left.parent.mkdir(exist_ok=True)
    left.write_bytes(b"a part of a file")
    board.request("confirm")
    board.step()
    names = {path.name for path in (board.own / "kept").iterdir()}
    assert names == {"ground", decoded((board.own / "state.a").read_bytes())["previous"]}


def test_a_file_that_does_not_fit_on_the_disk_leaves_no_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An incomplete index of 256 MiB would fill the disk, so that no state could be stored."""
    _fail_once(monkeypatch, renewal.os, "fsync", *range(3, 100))
    with pytest.raises(OSError, match="Input/output"):
        renewal.replace_file(tmp_path / "index", bytes(9))
    assert not list(tmp_path.iterdir())


def _bundle_of(path: Path, *names: str, size: int = 0, **headers: str) -> Path:
    """Write an unsigned bundle with files of zeros; `headers` are written into extended headers."""
    with tarfile.open(path, "w:xz") as archive:
        for name in names:
            member = tarfile.TarInfo(name)
            member.size, member.pax_headers = size, headers
            archive.addfile(member, io.BytesIO(bytes(size)))
    return path


@pytest.mark.parametrize(
    ("names", "size", "headers", "memory", "words"),
    [
        (["targets/release"], 1 << 21, {}, 1 << 27, ""),
        (["targets/release"], (1 << 21) + 1, {}, 1 << 27, "at most 2097152 are permitted"),
        (["targets/configuration"], (1 << 20) + 1, {}, 1 << 27, "at most 1048576 are permitted"),
        (["metadata/1.root.json"], (1 << 19) + 1, {}, 1 << 27, "at most 524288 are permitted"),
        (["targets/release"] * 2, 9, {}, 1 << 27, "contains 'targets/release', which is not part"),
        (["targets/release"], 9, {"comment": "x" * (1 << 20)}, 1 << 27, "which is not a file"),
        (["targets/release"], 9, {}, 1 << 22, "the bundle is damaged: Memory usage limit exceeded"),
    ],
)
def test_an_unsigned_bundle_exhausts_neither_memory_nor_disk(
    names: list[str], size: int, headers: dict[str, str], memory: int, words: str, tmp_path: Path
) -> None:
    open_bundle = script("open_bundle")
    bundle, kind = _bundle_of(tmp_path / "bundle", *names, size=size, **headers), names[0].partition("/")[2]
    with (
        patch.multiple(open_bundle, MOST_MEMORY=memory, LARGEST_TARGET=1 << 21),
        pytest.raises(open_bundle.Refused, match=words) if words else contextlib.nullcontext(),
    ):
        open_bundle.unpack(bundle, kind, tmp_path / "unpacked")
    written = sum(path.stat().st_size for path in tmp_path.rglob("unpacked/*/*"))
    assert written == (9 if len(names) == 2 else 0 if words else size)


def test_sources_are_not_larger_than_their_archive_and_limited_in_number(tmp_path: Path) -> None:
    open_bundle = script("open_bundle")
    sparse = tarfile.TarInfo("sparse")
    sparse.type = tarfile.GNUTYPE_SPARSE
    for name, members in (("a", [sparse]), ("b", [tarfile.TarInfo(f"file{number}") for number in range(3)])):
        with tarfile.open(tmp_path / name, "w") as archive:
            for member in members:
                archive.addfile(member)
    with tarfile.open(tmp_path / "c", "w:xz") as archive:
        archive.addfile(tarfile.TarInfo("file"))
    with pytest.raises(open_bundle.Refused, match="'sparse', which is neither a file nor a folder"):
        open_bundle.unpack_sources(tmp_path / "a", tmp_path / "source-a")
    with patch.object(open_bundle, "MOST_SOURCES", 3):
        open_bundle.unpack_sources(tmp_path / "b", tmp_path / "source-b")
    with (
        patch.object(open_bundle, "MOST_SOURCES", 2),
        pytest.raises(open_bundle.Refused, match="contains more than 2 files and folders"),
    ):
        open_bundle.unpack_sources(tmp_path / "b", tmp_path / "source-c")
    with pytest.raises(open_bundle.Refused, match="the release is damaged"):
        open_bundle.unpack_sources(tmp_path / "c", tmp_path / "source-d")


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE])
def test_sources_of_a_release_are_files_and_folders(tmp_path: Path, kind: bytes) -> None:
    open_bundle = script("open_bundle")
    member = tarfile.TarInfo("member")
    member.type, member.linkname = kind, "/etc/passwd"
    with tarfile.open(tmp_path / "artefact", "w") as archive:
        archive.addfile(member)
    with pytest.raises(open_bundle.Refused, match="'member', which is neither a file nor a folder"):
        open_bundle.unpack_sources(tmp_path / "artefact", tmp_path / "source")


def test_records_have_the_same_form_at_both_ends() -> None:
    values = {"a": [1, "b", None]}
    assert renewal.encoded(values) == encoded(values)
    assert renewal.decoded(encoded(values)) == decoded(encoded(values)) == values
    for reading in (decoded, renewal.decoded):
        with pytest.raises(ValueError, match=r"checksum|line 1 column 1"):
            reading(encoded(values).replace(b"1", b"2", 1))
