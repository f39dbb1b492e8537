"""Tests of commands over the link: reports, key changes, repetition, and files within a data rate."""

from __future__ import annotations

import argparse
import hashlib
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from flight.link.commands import Ping, unpack
from flight.link.files.store import Incoming, Store
from flight.link.files.units import DOWN, UP, UnitPacker, is_unit
from flight.link.frames import LONGEST_FRAME
from flight.link.process import directives
from flight.link.process.commanding import Report, Request, Stage
from flight.link.process.directives import NewKey, SendFile
from flight.link.security import NEXT, USED_KEY, Association, Refusal, Vault
from flight.link.telemetry.definitions import TRANSFER, VERIFICATION
from flight.link.telemetry.packets import LAYOUTS, Packer
from ground.link import commanding
from ground.link.terminal import FRAME_OVERHEAD_BYTES, TerminalSettings, make_keys
from knightcube.errors import KnightCubeError, UsageError

S = 1_000_000_000
LONGEST_PACKET = TerminalSettings().command_frame_bytes - FRAME_OVERHEAD_BYTES


def report(stage: Stage, text: str = "", counter: int = 0, spi: int = 1) -> Report:
    """Return a report on a command."""
    return Report(spi, counter, stage, "ping", text, Request(0, 0))


class FakeTerminal:
    """A test double of the terminal, which stores sent packets and answers with given reports."""

    packet_bytes = LONGEST_PACKET

    def __init__(self, vault: Vault | None = None, *answers: list[Report]) -> None:
        self.vault = vault
        self.answers = list(answers)
        self.sent: list[bytes] = []
        self.names: list[Any] = []
        self.gate = SimpleNamespace(admitted=0, refused=Counter())
        self.learned = 0
        self.reported = False
        self.lost_spis: tuple[int, ...] = ()

    def sealer(self, spi: int, block: int) -> Any:
        return SimpleNamespace(name=spi, block=block, _name=spi)

    def send(self, packet: bytes, spi: int = 1) -> int:
        return self.send_by(SimpleNamespace(_name=spi), packet)

    def send_by(self, sealer: Any, packet: bytes) -> int:
        self.sent.append(packet)
        self.names.append(sealer._name)
        return len(self.sent)

    def learn_counters(self, seconds: float) -> None:
        self.learned += 1

    def follow(self, counter: int, spi: int, seconds: float, *, reported: bool = False) -> Iterator[Report]:
        assert reported is self.reported
        for found in self.answers.pop(0) if self.answers else []:
            self.reported = True
            yield found


def terminal(vault: Vault | None = None, *answers: list[Report]) -> Any:
    """Return a test double of the terminal that answers each command with a list of reports."""
    return FakeTerminal(vault, *answers)


@pytest.mark.parametrize(
    ("stages", "obeyed", "text"),
    [
        ([], False, ""),
        ([Stage.ACCEPTED], False, ""),
        ([Stage.ACCEPTED, Stage.STARTED], True, ""),
        ([Stage.ACCEPTED, Stage.STARTED, Stage.COMPLETED], True, ""),
        ([Stage.REFUSED], False, "0"),
        ([Stage.ACCEPTED, Stage.FAILED], False, "1"),
    ],
)
def test_the_last_report_shows_whether_a_command_was_obeyed(
    stages: list[Stage], obeyed: bool, text: str
) -> None:
    reports = [report(stage, str(k)) for k, stage in enumerate(stages)]
    assert commanding.obeyed(reports) is obeyed
    assert commanding.failed(reports) == text


def test_each_report_is_shown_and_none_is_an_error() -> None:
    shown: list[Report] = []
    answers = [report(Stage.ACCEPTED), report(Stage.COMPLETED)]
    assert commanding.command(terminal(None, answers), b"x", 1, 2.0, shown.append) == answers == shown
    with pytest.raises(KnightCubeError, match=r"within 2\.5 s"):
        commanding.command(terminal(), b"x", 1, 2.5, shown.append)


@pytest.mark.parametrize(
    ("admitted", "refused", "cause"),
    [
        (7, {Refusal.MAC: 1}, "telemetry arrives, but the command or its reports were lost"),
        (0, {Refusal.MAC: 7}, r"7 frames of other keys \(--keys\) were received"),
        (0, {Refusal.HEADER: 7}, r"7 frames of another spacecraft \(--spacecraft\) were received"),
        (0, {}, "no telemetry frame was received: check the address of --link"),
    ],
)
def test_a_missing_answer_has_a_cause(admitted: int, refused: dict[Refusal, int], cause: str) -> None:
    double = terminal()
    double.gate = SimpleNamespace(admitted=admitted, refused=Counter(refused))
    with pytest.raises(KnightCubeError, match=cause):
        commanding.command(double, b"x", 1, 2.5, lambda _: None)


@pytest.mark.parametrize(
    ("spi", "last", "learned"),
    [(1, Stage.COMPLETED, 0), (2, Stage.COMPLETED, 1), (1, Stage.REPEATED, 1)],
)
def test_the_counters_are_raised_if_they_may_be_too_low(spi: int, last: Stage, learned: int) -> None:
    """The link sends its counters once a second, possibly later than the reports on a command."""
    double = terminal(None, [report(last, spi=spi)])
    commanding.command(double, b"x", spi, 2.0, lambda _: None)
    assert double.learned == learned


def test_a_counter_that_the_satellite_has_lost_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    double = terminal(None, [report(Stage.COMPLETED, spi=2)])
    double.lost_spis = (1,)
    commanding.command(double, b"x", 2, 2.0, lambda _: None)
    assert "lost the counter of SPI 1: set a new key by `--spi 2 new-key 1`" in capsys.readouterr().err


def test_a_ping_follows_each_silence_so_that_a_restarted_link_knows_the_ground() -> None:
    double = terminal(None, [report(Stage.ACCEPTED)], [], [], [report(Stage.FAILED)])
    found = commanding.command(double, b"x", 1, 20.0, lambda _: None)
    assert [one.stage for one in found] == [Stage.ACCEPTED, Stage.FAILED]
    assert [unpack(packet) for packet in double.sent[1:]] == [Ping()] * 3


def test_a_ping_follows_every_20_s_so_that_the_link_does_not_forget_the_ground() -> None:
    """Otherwise a UDP line discards the reports of some seconds in each minute."""

    class Heard(FakeTerminal):
        def follow(self, *_: Any, **__: Any) -> Iterator[Report]:
            self.gate.admitted += 1
            return iter([report(Stage.ACCEPTED)])

    double: Any = Heard()
    commanding.command(double, b"x", 1, 60.0, lambda _: None)
    assert [unpack(packet) for packet in double.sent[1:]] == [Ping()] * 2


def test_a_file_session_without_units_to_send_sends_a_ping_every_20_s(tmp_path: Path) -> None:
    line = terminal()
    files = session(tmp_path, line)
    for second in range(66):
        files.transmit(second * 10**9)
    assert [unpack(packet) for packet in line.sent] == [Ping()] * 3


def test_a_command_is_followed_until_its_caller_has_seen_enough() -> None:
    answers = [report(Stage.ACCEPTED), report(Stage.STARTED), report(Stage.STARTED)]
    found = commanding.command(
        terminal(None, answers), b"x", 1, 20.0, lambda _: None, lambda found: len(found) == 2
    )
    assert found == answers[:2]


@pytest.fixture
def vault(tmp_path: Path) -> Vault:
    """Return the ground's key file."""
    make_keys(tmp_path / "keys")
    return Vault(tmp_path / "keys" / "ground")


def sent_key(packet: bytes) -> NewKey:
    """Return the key change that a command packet contains."""
    directive = directives.unpack(packet)
    assert isinstance(directive, NewKey)
    return directive


def test_a_new_command_key_replaces_the_old_one_when_the_satellite_has_it(vault: Vault) -> None:
    line = terminal(vault, [report(Stage.COMPLETED)])
    old = vault.read(1)
    assert old is not None
    assert commanding.obeyed(commanding.change_key(line, vault, 1, 2, 1.0, lambda _: None))
    order = sent_key(line.sent[0])
    now = vault.read(1)
    assert now is not None
    assert (order.spi, order.generation, bytes(order.key)) == (1, old.generation + 1, now.key)
    assert (now.generation, now.unused, now.key == old.key) == (2, 0, False)
    assert vault.read(f"1-{NEXT}") is None


def test_a_refused_key_is_kept_for_the_next_attempt(vault: Vault) -> None:
    refused = terminal(vault, [report(Stage.REFUSED)])
    commanding.change_key(refused, vault, 1, 2, 1.0, lambda _: None)
    kept, old = vault.read(f"1-{NEXT}"), vault.read(1)
    assert kept is not None
    assert old is not None
    assert (kept.generation, old.generation) == (2, 1)
    silent = terminal(vault, [], [report(Stage.COMPLETED)])
    commanding.change_key(silent, vault, 1, 2, 1.0, lambda _: None)
    assert silent.names == [f"1-{NEXT}", 2], "a ping by the new key, then the same key again"
    assert bytes(sent_key(silent.sent[1]).key) == kept.key


def test_a_key_that_the_satellite_had_is_not_sent_again(vault: Vault) -> None:
    """A satellite whose key folder was restored or rebuilt after a key change refuses this key."""
    used = replace(report(Stage.FAILED), text=f"SPI 1 {USED_KEY}: make a new key")
    refused = terminal(vault, [used])
    commanding.change_key(refused, vault, 1, 2, 1.0, lambda _: None)
    again = terminal(vault, [report(Stage.COMPLETED)])
    assert commanding.obeyed(commanding.change_key(again, vault, 1, 2, 1.0, lambda _: None))
    assert again.names == [2], "no ping by a key that the satellite does not have"
    assert sent_key(again.sent[0]).key != sent_key(refused.sent[0]).key


def test_a_new_key_that_cannot_be_stored_is_not_sent(vault: Vault, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Vault, "write", lambda *_: 0)
    line = terminal(vault)
    with pytest.raises(KnightCubeError, match="the new key of SPI 1 cannot be stored"):
        commanding.change_key(line, vault, 1, 2, 1.0, lambda _: None)
    assert line.sent == []


def test_a_new_key_that_cannot_replace_the_old_one_is_kept(
    vault: Vault, monkeypatch: pytest.MonkeyPatch
) -> None:
    line, write = terminal(vault, [report(Stage.ACCEPTED), report(Stage.COMPLETED)]), Vault.write
    monkeypatch.setattr(
        Vault, "write", lambda self, key, name: write(self, key, name) if NEXT in str(name) else 0
    )
    with pytest.raises(KnightCubeError, match="the new key of SPI 1 cannot be stored"):
        commanding.change_key(line, vault, 1, 2, 1.0, lambda _: None)
    following = vault.read(f"1-{NEXT}")
    assert following is not None
    assert following.generation == 2


def test_a_key_that_the_satellite_already_has_is_adopted_by_a_ping(vault: Vault) -> None:
    vault.write(Association(1, 2, 0, bytes(32)), f"1-{NEXT}")
    line = terminal(vault, [report(Stage.COMPLETED)])
    assert len(commanding.change_key(line, vault, 1, 2, 1.0, lambda _: None)) == 1
    assert line.names == [f"1-{NEXT}"]
    now = vault.read(1)
    assert now is not None
    assert (now.generation, now.key) == (2, bytes(32))


def test_a_kept_key_of_another_generation_is_replaced(vault: Vault) -> None:
    vault.write(Association(3, 7, 0, bytes(32)), f"3-{NEXT}")
    line = terminal(vault, [report(Stage.COMPLETED)])
    commanding.change_key(line, vault, 3, 2, 1.0, lambda _: None)
    order = sent_key(line.sent[0])
    assert (len(line.sent), order.spi, order.generation) == (1, 3, 2), "no ping by a telemetry key"
    kept, old = vault.read(f"3-{NEXT}"), vault.read(3)
    assert kept is not None
    assert old is not None
    assert (kept.generation, old.generation) == (2, 1), "the first frame under the new key replaces it"


def test_a_key_that_is_lost_on_the_ground_cannot_be_changed(vault: Vault) -> None:
    vault.remove(1)
    with pytest.raises(UsageError, match=r"SPI 1 .*new keys"):
        commanding.change_key(terminal(vault), vault, 1, 2, 1.0, lambda _: None)


def session(folder: Path, line: Any, rate: float = 1e6) -> commanding.FileSession:
    """Return a file session with a data rate in bytes/s."""
    return commanding.FileSession(line, Store(folder), 1, rate, 0)


def verification(counter: int, stage: Stage, spi: int = 1) -> bytes:
    """Return a verification packet."""
    values: dict[str, Any] = {
        field.name: "" if field.kind.startswith("S") else 0 for field in VERIFICATION.fields
    }
    return Packer().pack(VERIFICATION, 0, {**values, "counter": counter, "spi": spi, "stage": int(stage)})


def test_an_unanswered_directive_is_repeated_every_five_seconds(tmp_path: Path) -> None:
    line = terminal()
    files = session(tmp_path, line)
    files.ask(SendFile("a"), 0)
    files.transmit(5 * S - 1)
    assert len(line.sent) == 1
    files.transmit(5 * S)
    files.transmit(10 * S - 1)
    assert len(line.sent) == 2
    files.take([(0, verification(9, Stage.COMPLETED))], 6 * S)
    assert files.reports() == [], "of another command"
    files.take([(0, verification(2, Stage.ACCEPTED))], 7 * S)
    files.transmit(10 * S)
    assert len(line.sent) == 3, "acceptance is not yet an answer"
    files.take([(0, verification(3, Stage.COMPLETED))], 11 * S)
    files.transmit(20 * S)
    assert len(line.sent) == 3
    assert [one.stage for one in files.reports()] == [Stage.ACCEPTED, Stage.COMPLETED]
    assert files.reports() == []
    assert files.received_ns == 11 * S


def test_a_late_report_on_an_earlier_directive_does_not_complete_the_next(tmp_path: Path) -> None:
    files = session(tmp_path, terminal())
    files.ask(SendFile("a"), 0)
    files.ask(SendFile("b"), S)
    files.take([(0, verification(1, Stage.COMPLETED))], 2 * S)
    assert files.reports() == []
    files.take([(0, verification(2, Stage.COMPLETED))], 3 * S)
    assert [one.counter for one in files.reports()] == [2]


def test_a_report_of_another_spi_does_not_answer_a_directive(tmp_path: Path) -> None:
    """Each SPI has its own counters, so that two programs may use the same counter at the same time."""
    files = session(tmp_path, terminal())
    files.ask(SendFile("a"), 0)
    files.take([(0, verification(1, Stage.COMPLETED, spi=2))], S)
    assert files.reports() == []
    files.take([(0, verification(1, Stage.COMPLETED))], 2 * S)
    assert [one.spi for one in files.reports()] == [1]


def test_units_are_sent_within_the_rate(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(bytes(200_000))
    line = terminal()
    files = session(tmp_path / "store", line, rate=20_000.0)
    progress = files.put(tmp_path / "file", "name", 0)
    assert progress.name == "name"
    files.transmit(0)
    assert line.sent == [], "without time there is no credit"
    for step in range(1, 41):
        files.transmit(step * S // 20)
    assert all(is_unit(packet, UP) for packet in line.sent)
    overhead = FRAME_OVERHEAD_BYTES
    spent = sum(len(packet) + overhead for packet in line.sent)
    assert 40_000 - 1200 <= spent <= 40_000 + 1200
    before = len(line.sent)
    files.transmit(100 * S)
    burst = sum(len(packet) + overhead for packet in line.sent[before:])
    assert burst <= 2 * LONGEST_FRAME + 1200, "unused rate accumulates for a short time only"


def test_a_packet_that_cannot_be_sent_is_sent_by_the_next_call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the network fails, the segment that the transfer has already handed over must not be lost."""
    (tmp_path / "file").write_bytes(bytes(range(256)) * 20)
    sent: list[list[bytes]] = []
    for failures in (0, 3):
        line = terminal()
        files = session(tmp_path / f"store-{failures}", line)
        files.put(tmp_path / "file", "name", 0)
        send, left = line.send_by, failures

        def failing(sealer: Any, packet: bytes, send: Any = send) -> int:
            nonlocal left
            if left:
                left -= 1
                raise KnightCubeError("the network is unreachable")
            return int(send(sealer, packet))

        monkeypatch.setattr(line, "send_by", failing)
        for step in range(1, 20):
            with suppress(KnightCubeError):
                files.transmit(step * S // 20)
        sent.append([packet[16:-2] for packet in line.sent])  # without time and checksum
    assert len(sent[0]) > 3
    assert sent[1] == sent[0]


def test_the_satellites_reason_goes_before_our_own(tmp_path: Path) -> None:
    files = session(tmp_path, terminal())
    ours = SimpleNamespace(source=2, number=7, said="timeout")
    assert files.reason_of(cast(Any, ours)) == "timeout"
    values: dict[str, Any] = {
        field.name: "" if field.kind.startswith("S") else 0 for field in TRANSFER.fields
    }
    files.take([(0, Packer().pack(TRANSFER, 0, {**values, "source": 2, "number": 7, "text": "no room"}))], 1)
    assert files.reason_of(cast(Any, ours)) == "no room"


def test_a_failed_transfer_waits_for_the_reason_of_the_satellite(tmp_path: Path) -> None:
    """The satellite's reason is in a packet that may arrive after the end of the transfer."""
    files = session(tmp_path, terminal())
    values: dict[str, Any] = {
        field.name: "" if field.kind.startswith("S") else 0 for field in TRANSFER.fields
    }
    failed = SimpleNamespace(name="a", source=2, number=7, condition=4, said="filestore rejection")
    files.entity.ended.append(cast(Any, failed))
    assert not files.ended("a", 7)
    assert not files.ended("a", 7)
    packet = Packer().pack(TRANSFER, 0, {**values, "source": 2, "number": 7, "text": "a exists on board"})
    files.take([(0, packet)], 1)
    with pytest.raises(KnightCubeError, match="a: a exists on board"):
        files.ended("a", 7)


@pytest.mark.parametrize(
    ("name", "ranges", "earlier", "kept"),
    [
        ("log/flight-0001.ccsds", ((0, 6), (8, 10)), b"", b"012345"),
        ("log/flight-0001.ccsds", ((0, 6),), b"0123456", b"0123456"),
        ("log/flight-0001.ccsds", ((2, 6),), b"", b""),
        ("log/config.yaml", ((0, 6),), b"", b""),
    ],
)
def test_the_beginning_of_an_incomplete_log_can_be_evaluated(
    tmp_path: Path, name: str, ranges: tuple[tuple[int, int], ...], earlier: bytes, kept: bytes
) -> None:
    store = Store(tmp_path)
    record = Incoming(1, 7, name=name, size=10, kind=0, ranges=ranges)
    store.save(record)
    store.part(record).write_bytes(b"0123456789")
    place = store.received / name
    if earlier:
        place.parent.mkdir()
        place.write_bytes(earlier)
    session(tmp_path, terminal()).close(1)
    assert (place.read_bytes() if place.exists() else b"") == kept
    assert store.part(record).exists(), "the transfer continues"


def test_units_of_an_unknown_kind_are_ignored(tmp_path: Path) -> None:
    files = session(tmp_path, terminal())
    files.take([(0, UnitPacker(DOWN).pack(b"\xff\xff\xff", 0))], 5)
    assert files.received_ns == 5
    files.close(6)


def test_a_checksum_is_that_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    assert commanding.sha256_of(tmp_path / "a") == hashlib.sha256(b"abc").digest()
    with pytest.raises(KnightCubeError, match="missing"):
        commanding.sha256_of(tmp_path / "missing")


def _answering(server: socket.socket, answer: bytes) -> threading.Thread:
    """Answer one datagram in a thread."""

    def run() -> None:
        data, sender = server.recvfrom(4096)
        server.sendto(answer + data, sender)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def test_a_packet_is_exchanged_over_udp_and_over_a_unix_socket(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        thread = _answering(server, b"udp ")
        assert commanding.exchange(f"127.0.0.1:{server.getsockname()[1]}", b"ping", 20.0) == b"udp ping"
        thread.join(20.0)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(str(tmp_path / "s"))
        thread = _answering(server, b"unix ")
        assert commanding.exchange(str(tmp_path / "s"), b"ping", 20.0) == b"unix ping"
        thread.join(20.0)
        with pytest.raises(KnightCubeError, match=r"within 0\.01 s"):
            commanding.exchange(str(tmp_path / "s"), b"ping", 0.01)


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("inf"), float("nan")])
def test_a_timeout_is_a_positive_number(timeout: float) -> None:
    with pytest.raises(UsageError, match="--timeout"):
        commanding.exchange("nowhere", b"", timeout)


def test_an_address_without_a_flight_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(KnightCubeError, match="no flight"):
        commanding.exchange(str(tmp_path / "none"), b"x", 1.0)
    with pytest.raises((UsageError, KnightCubeError), match="99999"):
        commanding.exchange("127.0.0.1:99999", b"x", 1.0)


def test_a_link_needs_the_keys_of_the_ground() -> None:
    parser = argparse.ArgumentParser()
    commanding.add_link_options(parser, parser.add_mutually_exclusive_group())
    options = parser.parse_args(["--link", "tcp:127.0.0.1:9"])
    assert (options.link, options.keys) == ("tcp:127.0.0.1:9", None)
    with pytest.raises(UsageError, match="--keys"):
        commanding.terminal_of(options)


@pytest.mark.parametrize("extra", [[], ["--spacecraft", "3", "--frame-bytes", "300"]])
def test_the_settings_of_the_link_are_those_of_the_configuration_and_the_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extra: list[str]
) -> None:
    make_keys(tmp_path / "keys")
    opened: list[Any] = []
    monkeypatch.setattr(commanding, "open_terminal", lambda *given: opened.append(given))
    parser = argparse.ArgumentParser()
    commanding.add_link_options(parser, parser.add_mutually_exclusive_group())
    base = (Path(__file__).parents[3] / "config" / "orbit.yaml").read_text(encoding="utf-8")
    section = (
        "link: {keys: k, udp: '127.0.0.1:9', spacecraft: 7, frame_bytes: 888, command_frame_bytes: 200, "
        "encrypt_telemetry: false, coding: {randomiser: long, reed_solomon: 4, cltu: randomised}}\n"
    )
    base += "commands: {socket: /run/commands}\n"
    for name, text in (("with.yaml", base + section), ("without.yaml", base)):
        (tmp_path / name).write_text(text, encoding="utf-8")
    words = ["--link", "127.0.0.1:9", "--keys", str(tmp_path), *extra]
    commanding.terminal_of(parser.parse_args(words))
    commanding.terminal_of(parser.parse_args([*words, "--config", str(tmp_path / "with.yaml")]))
    plain, described = (settings for _, _, settings in opened)
    own = (3, 300) if extra else None
    assert (plain.spacecraft, plain.frame_bytes) == (own or (0x1A5, 1115))
    assert (described.spacecraft, described.frame_bytes) == (own or (7, 888))
    assert (described.command_frame_bytes, described.encrypted) == (200, False)
    coding = described.coding
    assert (coding.randomiser, coding.reed_solomon, coding.cltu) == ("long", 4, "randomised")
    with pytest.raises(UsageError, match=r"orbit.yaml: has no section `link`"):
        commanding.terminal_of(parser.parse_args([*words, "--config", "orbit"]))
    for wrong in (["--spacecraft", "5000"], ["--frame-bytes", "5"]):
        with pytest.raises(UsageError, match=f"{wrong[0]} {wrong[1]}: must be "):
            commanding.terminal_of(parser.parse_args([*words, *wrong]))
    with pytest.raises(UsageError, match=r"without.yaml: has no section `link`"):
        commanding.terminal_of(parser.parse_args([*words, "--config", str(tmp_path / "without.yaml")]))


def test_the_first_bytes_of_the_packets_are_those_of_the_table() -> None:
    assert LAYOUTS["verification"].identifier.to_bytes(2, "big") == commanding._VERIFICATION
