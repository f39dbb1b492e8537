"""Tests of file transfers over a link: commands, protected frames both ways, selection by SHA-256."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from flight.link.commands import CommandPacker, Ping
from flight.link.files.units import UP, FileData, UnitPacker, unit_of, unpack
from flight.link.process import directives, filing
from flight.link.process.directives import (
    CancelFile,
    DeleteFile,
    ListFiles,
    ResumeFile,
    SendFile,
    SuspendFile,
    UseFile,
)
from flight.link.process.downlink import FILES, LIVE
from flight.link.process.filing import LISTING
from flight.link.telemetry.definitions import TRANSFER
from flight.link.telemetry.packets import LAYOUTS
from tests.flight.link.process.filed_ends import FiledEnds
from tests.flight.link.telemetry.samples import timing_packets


@pytest.fixture
def link(tmp_path: Path) -> Iterator[FiledEnds]:
    both = FiledEnds(tmp_path)
    yield both
    both.close()


def config(link: FiledEnds, data: bytes = b"name: x\n") -> Path:
    path = link.place / "flight.yaml"
    path.write_bytes(data)
    return path


def test_the_log_comes_down_by_the_name_that_the_list_has(link: FiledEnds) -> None:
    link.record(*timing_packets(500))
    link.ask(ListFiles())
    link.until_closed()
    listing = json.loads((link.session.received / LISTING).read_bytes())
    (name,) = (file["name"] for file in listing["files"])
    assert name == "log/run-000001/flight-0001.ccsds"
    link.ask(SendFile(name))
    link.until_closed()
    log = link.place / "runs" / "run-000001" / "flight-0001.ccsds"
    assert (link.session.received / name).read_bytes() == log.read_bytes()
    assert [report.stage.name for report in link.session.reports()][-3:] == [
        "ACCEPTED",
        "STARTED",
        "COMPLETED",
    ]
    (row,) = LAYOUTS[TRANSFER.name].array(link.of(TRANSFER.name)[-1])
    assert (row["down"], row["open"], row["condition"], row["done"]) == (1, 0, 0, row["size"])


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_a_file_goes_up_through_losses_and_restarts_and_waits_to_be_chosen(
    tmp_path: Path, loss: float
) -> None:
    link = FiledEnds(tmp_path, loss=loss)
    path = config(link, np.random.default_rng(2).bytes(60_000))
    link.session.put(path, "configuration/flight.yaml", link.clock.now_ns())
    for _ in range(4):
        link.turn(0.2)
        link.restart()
    link.until_closed()
    came = link.place / "keys" / "files" / "received" / "configuration" / "flight.yaml"
    chosen = link.place / "keys" / "files" / "chosen" / "configuration"
    assert came.read_bytes() == path.read_bytes()
    assert not chosen.exists(), "a file was chosen by its arrival"
    assert link.obeyed == []
    name = "received/configuration/flight.yaml"
    assert "SHA-256" in link.command(UseFile(name, bytes(32)))
    assert link.command(UseFile(name, hashlib.sha256(path.read_bytes()).digest())) == "completed"
    assert [one.read_bytes() for one in chosen.iterdir()] == [path.read_bytes()]
    assert link.command(DeleteFile(name)) == "completed"
    assert not came.exists()
    assert (chosen / "flight.yaml").exists()
    link.close()


@pytest.mark.parametrize("listened", [True, False])
def test_a_file_waits_for_a_line_that_takes_no_frames_and_no_part_is_sent_twice(
    tmp_path: Path, listened: bool
) -> None:
    link = FiledEnds(tmp_path, rate=2e4)
    data = bytes(range(256)) * 600
    (link.place / "keys" / "files" / "received" / "file").write_bytes(data)
    link.ask(SendFile("received/file"))
    link.turn(2.0)
    link.wire.takes, link.wire.listened = 0, listened
    link.turn(5.0)  # after 10 s the receiver would request the missing data
    link.wire.takes, link.wire.listened = None, True
    link.until_closed()
    assert [one.condition for one in link.ended] == [0]
    contents = [unpack(unit_of(packet))[1] for channel, packet in link.packets if channel == FILES]
    parts = [one for one in contents if isinstance(one, FileData)]
    assert b"".join(part.data for part in parts) == data, "each part arrives once and in order"
    link.close()


class Undrained(FiledEnds):
    """Both ends, whose file session alone processes the ended transfers."""

    def collect(self) -> None:
        packets = list(self.terminal.take())
        self.packets += packets
        self.session.take(packets, self.clock.now_ns())
        self.session.transmit(self.clock.now_ns())


def test_a_list_that_has_grown_since_an_interrupted_transfer_is_received_as_it_is_now(tmp_path: Path) -> None:
    link = Undrained(tmp_path, rate=2e3)
    link.record(*timing_packets(10))
    for n in range(90):
        (link.place / f"runs/run-000001/{n}.txt").touch()
    link.ask(ListFiles())
    while not link.session.entity.transfers():
        link.turn(0.02)
    link.session.entity.keep(0, at_once=True)
    link.wire.takes, link.wire.listened = 0, False
    link.turn(2.0)
    assert link.station.transfers == len(link.session.entity.transfers()) == 1
    (link.place / "runs/run-000001/later.ccsds").write_bytes(b"later")
    link.restart()
    link.wire.takes, link.wire.listened = None, True
    link.ask(ListFiles())
    while not link.session.received_file(LISTING):
        link.turn(0.02)
    listing = json.loads((link.session.received / LISTING).read_bytes())
    assert "log/run-000001/later.ccsds" in [file["name"] for file in listing["files"]]
    link.close()


@pytest.mark.parametrize("listened", [True, False])
def test_an_uplinked_file_is_stored_while_the_satellite_cannot_send(link: FiledEnds, listened: bool) -> None:
    link.wire.takes, link.wire.listened = 0, listened
    path = config(link, np.random.default_rng(3).bytes(20_000))
    link.session.put(path, "configuration/flight.yaml", link.clock.now_ns())
    link.turn(5.0)
    came = link.place / "keys" / "files" / "received" / "configuration" / "flight.yaml"
    assert came.read_bytes() == path.read_bytes()


def test_only_the_last_selected_file_of_a_kind_is_kept(link: FiledEnds) -> None:
    folder = link.place / "keys" / "files"
    for name in ("a.tle", "b.tle"):
        (folder / "received" / "elements").mkdir(exist_ok=True)
        (folder / "received" / "elements" / name).write_bytes(name.encode())
        wanted = hashlib.sha256(name.encode()).digest()
        assert link.command(UseFile(f"received/elements/{name}", wanted)) == "completed"
    assert [path.name for path in (folder / "chosen" / "elements").iterdir()] == ["b.tle"]
    assert sorted(path.name for path in (folder / "received" / "elements").iterdir()) == ["a.tle", "b.tle"]


def test_temporary_files_of_a_killed_process_are_removed_at_the_start(link: FiledEnds) -> None:
    folder = link.place / "keys" / "files"
    (folder / "received" / "elements").mkdir()
    kept = folder / "received" / "elements" / "a.tle"
    kept.write_bytes(b"kept")
    left = [folder / name for name in ("chosen/elements~", "transfers/out-0000000001.json~", "listing.json~")]
    left.append(link.place / "keys" / "renewal" / "1-2-3-4~")
    for path in left:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"left")
    link.restart()
    assert not any(path.exists() for path in left)
    assert kept.read_bytes() == b"kept"
    unfinished = link.session.entity._store._folder / "in-00001-0000000001.json~"
    unfinished.write_bytes(b"left")
    with link.session.entity._store.owned():
        assert not unfinished.exists()


def test_a_file_that_changes_while_it_is_checked_is_chosen_as_it_was_checked(
    link: FiledEnds, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(filing, "_PORTION", 1)
    folder = link.place / "keys" / "files"
    path = folder / "received" / "elements" / "a.tle"
    path.parent.mkdir()
    path.write_bytes(b"checked")
    link.ask(UseFile("received/elements/a.tle", hashlib.sha256(b"checked").digest()))
    link.turn(0.06)
    other = path.with_name("b.tle")
    other.write_bytes(b"another")
    other.replace(path)
    link.turn(2.0)
    assert [report.stage.name for report in link.session.reports()][-1] == "COMPLETED"
    assert (folder / "chosen" / "elements" / "a.tle").read_bytes() == b"checked"


def test_of_two_files_that_are_checked_at_once_each_is_chosen_as_it_was_checked(
    link: FiledEnds, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two files whose checks overlap are both selected, although both are copied to the same temporary file.

    The longer file is requested first, so that its check still runs when the shorter file is requested.
    """
    monkeypatch.setattr(filing, "_PORTION", 1)
    folder = link.place / "keys" / "files"
    (folder / "received" / "elements").mkdir()
    for name, data in (("a.tle", b"a" * 9), ("b.tle", b"b" * 3)):
        (folder / "received" / "elements" / name).write_bytes(data)
        link.terminal.send(
            directives.pack(UseFile(f"received/elements/{name}", hashlib.sha256(data).digest()), 1)
        )
    chosen: set[tuple[str, bytes]] = set()
    for _ in range(100):
        link.turn(0.02)
        chosen |= {(path.name, path.read_bytes()) for path in (folder / "chosen" / "elements").glob("*")}
    assert chosen == {("a.tle", b"a" * 9), ("b.tle", b"b" * 3)}
    assert [path.name for path in (folder / "chosen" / "elements").iterdir()] == ["b.tle"]


@pytest.mark.parametrize("name", [b"bad\xff", b"loop"])
def test_a_name_that_is_not_utf_8_in_the_log_does_not_end_the_link(link: FiledEnds, name: bytes) -> None:
    """The link continues if the log contains a file name that is not UTF-8, or a symbolic link to itself."""
    link.record(*timing_packets(50))
    run = link.place / "runs" / "run-000001"
    if name == b"loop":
        (run / "loop").symlink_to("loop")
    else:
        (run / os.fsdecode(name)).write_bytes(b"")
    link.command(ListFiles())
    assert link.command(SendFile(f"log/run-000001/{name.decode(errors='replace')}")) != "completed"
    assert link.command(SendFile("log/run-000001/flight-0001.ccsds")) == "completed"


def test_a_file_on_board_is_replaced_only_after_it_was_deleted(link: FiledEnds) -> None:
    for data, condition in ((b"first", 0), (b"second", 4)):
        link.session.put(config(link, data), "configuration/a", link.clock.now_ns())
        link.until_closed()
        assert link.ended[-1].condition == condition
    assert "exists on board" in link.session.reason_of(link.ended[-1])
    came = link.place / "keys" / "files" / "received" / "configuration" / "a"
    assert came.read_bytes() == b"first"
    assert link.command(DeleteFile("received/configuration/a")) == "completed"
    link.session.put(config(link, b"second"), "configuration/a", link.clock.now_ns())
    link.until_closed()
    assert came.read_bytes() == b"second"


def test_a_file_that_was_not_asked_for_replaces_no_file_on_the_ground(link: FiledEnds) -> None:
    link.record(*timing_packets(50))
    name = "log/run-000001/flight-0001.ccsds"
    kept = link.session.received / name
    kept.parent.mkdir(parents=True)
    kept.write_bytes(b"kept")
    command = directives.pack(SendFile(name), 1)
    link.terminal.send(command)
    link.turn(3.0)
    assert kept.read_bytes() == b"kept"
    link.ask(SendFile(name))
    link.until_closed()
    assert kept.read_bytes() != b"kept"


@pytest.mark.parametrize(
    "name", ["log/../../keys/satellite/1.a", "keys/1.a", "/etc/passwd", "log/link", "log", "received/none"]
)
def test_no_file_outside_the_two_folders_is_sent_or_deleted(link: FiledEnds, name: str) -> None:
    (link.place / "secret").write_text("x")
    (link.place / "runs" / "link").symlink_to(link.place / "secret")
    assert "such file" in (said := link.command(SendFile(name))) or "name" in said
    assert link.command(DeleteFile(name)) != "completed"
    assert (link.place / "secret").exists()


@pytest.mark.parametrize("name", ["flight.yaml", "secret/x", "configuration/a/b", "configuration"])
def test_only_files_of_known_kinds_are_uplinked(link: FiledEnds, name: str) -> None:
    link.session.put(config(link), name, link.clock.now_ns())
    link.until_closed()
    (ended,) = link.ended
    assert ended.condition == 4
    assert "KIND/NAME" in link.session.reason_of(ended)


def test_the_number_of_received_files_is_limited(link: FiledEnds, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(filing, "MOST_RECEIVED", 5)
    link.session.put(config(link), "configuration/a", link.clock.now_ns())
    link.until_closed()
    assert "delete files that are not needed" in link.session.reason_of(link.ended[0])


def test_wrong_units_are_refused_in_words_and_unknown_transfers_reported(link: FiledEnds) -> None:
    counter = link.terminal.send(UnitPacker(UP).pack(b"no unit", 1))
    link.turn()
    assert link.stages(counter) == ["refused"]
    assert "no transfer 7" in link.command(CancelFile(1, 7))
    assert "no transfer 7" in link.command(SuspendFile(1, 7))
    assert "no transfer 7" in link.command(ResumeFile(1, 7))


def test_verification_and_live_telemetry_come_before_a_file(tmp_path: Path) -> None:
    link = FiledEnds(tmp_path, rate=6000.0)
    link.record(*timing_packets(2000))
    link.turn(5.0)
    link.ask(SendFile("log/run-000001/flight-0001.ccsds"))
    link.turn(2.0)
    before = len(link.packets)
    sent = timing_packets(100)
    link.record(*sent[:50])
    counter = link.terminal.send(CommandPacker().pack(Ping(1), link.clock.utc_ns()))
    link.turn(2.0)
    newer = link.packets[before:]
    assert link.stages(counter) == ["accepted", "started", "completed"]
    assert [one for channel, one in newer if channel == LIVE and one in sent] == sent[:50]
    assert sum(channel == FILES for channel, _ in newer) > 3, "the file stands still"
    link.close()


def test_directives_are_equal_after_packing_and_unpacking() -> None:
    for directive in (
        ListFiles("log/"),
        SendFile("log/a", 3),
        CancelFile(2, 7),
        SuspendFile(2, 7),
        ResumeFile(2, 7),
        UseFile("received/a/b", bytes(range(32))),
        DeleteFile("received/a/b"),
    ):
        assert directives.unpack(directives.pack(directive, 1)) == directive
