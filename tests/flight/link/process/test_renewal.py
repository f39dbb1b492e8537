"""Tests that the link passes update requests to the privileged update program, and reports its results."""

from __future__ import annotations

import errno
import hashlib
import os
import resource
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from flight.link import events
from flight.link.events import Mode
from flight.link.files import store
from flight.link.process import filing
from flight.link.process.commanding import Report, Request, Stage
from flight.link.process.directives import Activate, Confirm, Listing, Withdraw
from flight.link.process.filing import MOST_WAITING, Renewal, decoded, encoded
from flight.link.security import Vault
from flight.link.telemetry.definitions import EVENT, FIX
from tests.flight.link.process.both_ends import BothEnds
from tests.flight.link.process.filed_ends import FiledEnds
from tests.flight.link.telemetry.samples import plain_contents

DATA = b"a bundle" * 100


class Ends(FiledEnds):
    """The satellite's and the ground's end of a link, and the status file of the privileged program."""

    def __init__(self, place: Path) -> None:
        self.renewal = place / "status"
        super().__init__(place)

    def write_status(self, *reports: list[object]) -> None:
        """Write reports as the privileged program does."""
        self.renewal.write_bytes(encoded({"reports": reports, "trial": "", "note": ""}))

    def requests(self) -> dict[str, dict[str, object]]:
        """Return the stored requests, by name."""
        folder = self.place / "keys/renewal"
        return {path.name: decoded(path.read_bytes()) for path in sorted(folder.glob("1-*"))}


@pytest.fixture
def ends(tmp_path: Path) -> Iterator[Ends]:
    made = Ends(tmp_path)
    made.write_status()
    yield made
    made.close()


def put(ends: Ends) -> Activate:
    """Uplink a bundle, and return the directive that activates it."""
    path = ends.place / "configuration-2.renewal"
    path.write_bytes(DATA)
    ends.session.put(path, f"configuration/{path.name}", ends.clock.now_ns())
    ends.until_closed()
    return Activate(f"received/configuration/{path.name}", hashlib.sha256(DATA).digest(), 24.0, 1)


def stages(ends: BothEnds, name: str) -> list[tuple[str, str]]:
    """Return stages and texts of the reports about a command."""
    return [(r.stage.name.lower(), r.text) for r in ends.reports() if r.name == name]


def test_an_activation_is_a_request_for_exactly_the_checked_bytes(ends: Ends) -> None:
    ends.ask(put(ends))
    ends.turn(1.0)
    ((name, request),) = ends.requests().items()
    assert request == {
        "do": "activate",
        "kind": "configuration",
        "name": "configuration-2.renewal",
        "sum": hashlib.sha256(DATA).hexdigest(),
        "hours": 24.0,
        "despite_faults": True,
    }
    chosen = ends.place / "keys/files/chosen/configuration/configuration-2.renewal"
    assert chosen.read_bytes() == DATA
    assert [stage for stage, _ in stages(ends, "activate")] == ["accepted", "started"]
    ends.write_status([1, name, "started", "activate", "trial of 24 h"])
    ends.turn(2.5)
    ends.write_status(
        [1, name, "started", "activate", "trial of 24 h"], [2, name, "failed", "activate", "no"]
    )
    ends.turn(2.5)
    assert stages(ends, "activate")[2:] == [("started", "trial of 24 h"), ("failed", "no")]
    counter = int(name.split("-")[1])
    assert [report.counter for report in ends.reports() if report.name == "activate"] == [counter] * 4
    ends.restart()
    ends.turn(2.5)
    assert len(stages(ends, "activate")) == 4, "a restarted link repeats no report"


def test_a_report_that_could_not_be_read_once_is_sent_later(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    ends.turn(2.5)
    with monkeypatch.context() as broken:
        broken.setattr(filing, "read_regular", fail)
        ends.write_status([1, "", "failed", "activate", "no"])
        ends.turn(2.5)
    assert stages(ends, "activate") == []
    ends.turn(2.5)
    assert stages(ends, "activate") == [("failed", "no")]


def test_a_folder_that_cannot_be_read_does_not_end_the_link(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    directive, stat = put(ends), os.stat

    def fail(path: object, **options: bool) -> os.stat_result:
        if str(path).startswith((str(ends.place / "keys/files/received/"), str(ends.renewal.parent) + "/s")):
            raise OSError(errno.EIO, "Input/output error")
        return stat(path, **options)  # type: ignore[arg-type]  # as called

    with monkeypatch.context() as broken:
        broken.setattr(os, "stat", fail)
        ends.ask(directive)
        ends.ask(Confirm(0))
        ends.turn(2.5)
    assert stages(ends, "activate")[-1][0] == "failed"
    assert stages(ends, "confirm")[-1][0] == "failed"


def test_an_activation_has_the_time_of_the_receiver_and_never_that_of_the_host(ends: Ends) -> None:
    directive, utc = put(ends), 1_900_000_000

    def asked() -> object:
        ends.ask(directive)
        ends.turn(3.0)
        newest = max(ends.requests().items(), key=lambda item: int(item[0].split("-")[1]))
        return newest[1].get("utc")

    ends.turn(3.0)
    for used, second in ((0, utc + 50), (1, utc)):
        assert asked() is None, "no fix was used"
        fields = {**plain_contents(FIX), "used": used, "utc_ns": second * 10**9}
        ends.record(ends.packer.pack(FIX, ends.clock.now_ns(), fields))
        ends.turn(3.0)
    known = asked()
    assert isinstance(known, int)
    assert utc <= known < utc + 60


def test_other_bytes_are_not_requested(ends: Ends) -> None:
    directive = put(ends)
    assert "its SHA-256 is" in ends.command(Activate(directive.name, bytes(32), 24.0, 0))
    assert ends.requests() == {}


def test_confirmation_and_withdrawal_are_requests(ends: Ends) -> None:
    ends.ask(Confirm(3))
    ends.ask(Withdraw(1))
    ends.turn(1.0)
    assert list(ends.requests().values()) == [
        {"do": "confirm", "kind": "release"},
        {"do": "withdraw", "kind": "elements"},
    ]


def test_requests_that_nobody_executes_do_not_fill_the_disk(ends: Ends) -> None:
    for _ in range(MOST_WAITING + 1):
        ends.ask(Confirm(0))
        ends.turn(1.0)
    found = stages(ends, "confirm")
    assert [stage for stage, _ in found if stage != "accepted"] == ["started"] * MOST_WAITING + ["failed"]
    assert "16 requests wait for the renewal program" in found[-1][1]
    assert len(ends.requests()) == MOST_WAITING
    (ends.place / "keys/renewal" / next(iter(ends.requests()))).unlink()
    ends.ask(Confirm(0))
    ends.turn(1.0)
    assert stages(ends, "confirm")[-1][0] == "started"


def test_checks_of_bundles_are_limited_in_number_and_by_the_disk(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    directive = put(ends)
    for _ in range(MOST_WAITING + 1):
        ends.ask(directive)
    ends.turn(2.0)
    failures = [text for stage, text in stages(ends, "activate") if stage == "failed"]
    assert failures == ["16 files wait for their check: send the command again later"]
    problem = "the disk has no room for the selected copy: delete files"
    for path in (ends.place / "keys/renewal").glob("1-*"):
        path.unlink()
    for missing, end in ((1, ("failed", problem)), (0, ("started", f"{directive}: handed over"))):
        usage = SimpleNamespace(free=(1 << 20) + len(DATA) - missing)
        monkeypatch.setattr(store, "shutil", SimpleNamespace(disk_usage=lambda _, usage=usage: usage))
        ends.ask(directive)
        ends.turn(2.0)
        assert stages(ends, "activate")[-1] == end


def test_a_copy_for_a_check_that_fails_leaves_no_file(ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    directive = put(ends)

    def fail(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(os, "fsync", fail)
        broken.setattr(Vault, "advance", lambda *_: 2)
        ends.ask(directive)
        ends.turn(1.0)
    assert "No space left" in stages(ends, "activate")[-1][1]
    assert not list((ends.place / "keys/files/chosen").glob("*~"))


def test_a_board_without_the_privileged_program_refuses(ends: Ends) -> None:
    ends.renewal.unlink()
    assert "renewal service is not installed" in ends.command(Confirm(0))


@pytest.mark.parametrize(
    "content", [b"", b"{}\n", encoded([1]), encoded({"reports": [[1, "x"]]}), b"\xff" * 99]
)
def test_a_damaged_status_is_ignored(ends: Ends, content: bytes) -> None:
    ends.renewal.write_bytes(content)
    ends.turn(2.5)
    assert ends.command(Listing()) == "completed"


def test_the_contact_counts_authentic_frames_and_reactions_to_safe(ends: Ends) -> None:
    def contact() -> dict[str, object]:
        found: dict[str, object] = decoded((ends.place / "keys/renewal/contact").read_bytes())
        return found

    ends.turn(2.0)
    assert (contact()["frames"], contact()["fault"], contact()["limit_s"]) == ("0", "", 0.0)
    ends.wire.up.append(bytes(64))
    ends.record(ends.mode_packet(Mode.SAFE, "commanded safe"), ends.mode_packet(Mode.HOLD, "reaction hold"))
    ends.turn(12.0)
    assert (contact()["frames"], contact()["fault"]) == ("0", "")
    ends.ask(Confirm(0))
    ends.record(ends.mode_packet(Mode.SAFE, "reaction safe"))
    ends.turn(12.0)
    assert (contact()["frames"], contact()["fault"]) == ("1", "reaction safe")
    session = contact()["session"]
    ends.restart()
    ends.turn(2.0)
    assert contact()["session"] != session


@pytest.mark.parametrize(
    "kind",
    [events.IMU_SILENT, events.COIL_BROKEN, events.CONFIG_DAMAGED, events.DISK_LOW, events.MODE],
)
def test_the_contact_has_the_first_event_that_ends_a_trial(ends: Ends, kind: events.EventKind) -> None:
    for text in ("first", "second"):
        fields = {"code": kind.code, "severity": int(kind.severity), "suppressed": 0, "name": kind.name}
        ends.record(ends.packer.pack(EVENT, ends.clock.now_ns(), fields | {"text": text}))
        ends.turn(11.0)
    fault = decoded((ends.place / "keys/renewal/contact").read_bytes())["fault"]
    fails = kind.severity is events.Severity.FAULT or kind is events.CONFIG_DAMAGED
    assert fault == (f"{kind.name}: first" if fails else "")


def test_a_disk_that_cannot_be_written_is_reported_and_ends_nothing(tmp_path: Path) -> None:
    status = tmp_path / "status"
    status.write_bytes(encoded({"reports": [[1, "", "completed", "command-loss", "x"]]}))
    renewal = Renewal(tmp_path / "missing" / "folder", status, 5.0)
    assert [report.text for report in renewal.turn(1, 0)] == ["x"]
    assert renewal.turn(2, 10**12) == []


def test_a_request_that_cannot_be_stored_completely_does_not_exist(tmp_path: Path) -> None:
    status = tmp_path / "status"
    status.write_bytes(encoded({"reports": []}))
    renewal = Renewal(tmp_path / "folder", status, 5.0)
    done = Report(1, 5, Stage.COMPLETED, "confirm", "", Request(0, 0))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, limits[1]))
    try:
        problem = renewal.request(Confirm(0), done, 0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert problem == "the request could not be stored"
    assert not list((tmp_path / "folder").glob("*-0"))
    assert renewal.request(Confirm(0), done, 0) == ""
    (path,) = (tmp_path / "folder").glob("*-0")
    assert decoded(path.read_bytes()) == {"do": "confirm", "kind": "configuration"}
