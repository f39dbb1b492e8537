"""Tests of transfers with cfdp-py, an independent CFDP implementation, over a lossy channel."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.link.files.store import Store
from flight.link.files.transfer import CRC32, CRC32C, FOREIGN, MODULAR, NO_CHECKSUM, NOBODY, SATELLITE, Entity

pytest.importorskip("cfdppy", reason="cfdp-py is not installed (extra `test`)")

from cfdppy import exceptions
from cfdppy.handler.dest import DestHandler, acknowledge_inactive_eof_pdu
from cfdppy.handler.source import SourceHandler
from cfdppy.mib import (
    CheckTimerProvider,
    DefaultFaultHandlerBase,
    IndicationConfig,
    LocalEntityConfig,
    RemoteEntityConfig,
    RemoteEntityConfigTable,
)
from cfdppy.request import PutRequest
from cfdppy.user import CfdpUserBase
from spacepackets import countdown
from spacepackets.cfdp import ChecksumType, ConditionCode, Direction, PduFactory, TransmissionMode
from spacepackets.cfdp.pdu import AckPdu, DirectiveType, EofPdu, FinishedPdu, TransactionStatus
from spacepackets.countdown import Countdown
from spacepackets.seqcount import SeqCountProvider
from spacepackets.util import ByteFieldU16

SIZE = 30_001
STEP_S, LONGEST_S = 0.1, 3000.0
CANCELLED = 15
_IGNORED = tuple(
    one for one in vars(exceptions).values() if isinstance(one, type) and issubclass(one, Exception)
)


class User(CfdpUserBase):  # type: ignore[misc]
    """Record of the condition with which each transfer ended."""

    def __init__(self) -> None:
        super().__init__()
        self.ended: dict[Any, ConditionCode] = {}

    def transaction_finished_indication(self, params: Any) -> None:
        self.ended[params.transaction_id] = params.finished_params.condition_code

    def _nothing(self, *_: Any, **__: Any) -> None:
        pass

    transaction_indication = eof_sent_indication = metadata_recv_indication = _nothing
    file_segment_recv_indication = report_indication = suspended_indication = _nothing
    resumed_indication = fault_indication = abandoned_indication = eof_recv_indication = _nothing


class Faults(DefaultFaultHandlerBase):  # type: ignore[misc]
    """Fault handler of cfdp-py whose callbacks do nothing."""

    def notice_of_suspension_cb(self, *_: Any) -> None:
        pass

    notice_of_cancellation_cb = abandoned_cb = ignore_cb = notice_of_suspension_cb


class Timers(CheckTimerProvider):  # type: ignore[misc]
    def provide_check_timer(self, *_: Any, **__: Any) -> Countdown:
        return Countdown.from_seconds(5.0)


class Ends:
    """KnightCube as the satellite end, cfdp-py as the ground end, and the channel between them."""

    def __init__(
        self,
        place: Path,
        monkeypatch: pytest.MonkeyPatch,
        loss: float,
        kind: int = MODULAR,
        crc: bool = False,
    ) -> None:
        self.now_ns = 0
        monkeypatch.setattr(countdown, "time_ms", lambda: self.now_ns // 1_000_000)
        self.store = Store(place / "satellite")
        self.ours = Entity(SATELLITE, self.store, lambda _: "", 1 << 20, 0)
        self.user, self.loss, self.draw = User(), loss, np.random.default_rng(7)
        local = LocalEntityConfig(ByteFieldU16(FOREIGN), IndicationConfig(), Faults())
        remote = RemoteEntityConfig(
            ByteFieldU16(SATELLITE),
            max_file_segment_len=400,
            max_packet_len=900,
            closure_requested=False,
            crc_on_transmission=crc,
            default_transmission_mode=TransmissionMode.ACKNOWLEDGED,
            crc_type=ChecksumType(kind),
            positive_ack_timer_interval_seconds=5.0,
            positive_ack_timer_expiration_limit=1000,
            nak_timer_interval_seconds=5.0,
            nak_timer_expiration_limit=1000,
        )
        table = RemoteEntityConfigTable([remote])
        self.dest = DestHandler(local, self.user, table, Timers())
        self.source = SourceHandler(local, self.user, table, Timers(), SeqCountProvider(32))

    def put(self, path: Path) -> None:
        """Begin to uplink a file."""
        assert self.source.put_request(
            PutRequest(ByteFieldU16(SATELLITE), path, Path("up"), TransmissionMode.ACKNOWLEDGED, None)
        )

    def get(self, path: Path, kind: int, received: Path) -> int:
        """Start the downlink of a file and return its transaction number."""
        return self.ours.send(path, received.name, FOREIGN, kind, 10**9, self.now_ns, NOBODY).number

    def turn(self, seconds: float = STEP_S) -> None:
        """Make both ends send their queued data units."""
        until = self.now_ns + round(seconds * 1e9)
        while self.now_ns < until:
            self.now_ns += round(STEP_S * 1e9)
            self.ours.work(self.now_ns)
            self.ours.keep(self.now_ns)
            for _ in range(8):
                if (unit := self.ours.unit(self.now_ns)) is not None and self._arrives():
                    self._give(PduFactory.from_raw(unit))
                self._go_on()

    def until_closed(self) -> None:
        """Advance the clock until both ends have closed all transfers. Raises TimeoutError."""
        while self.ours.transfers() or self.source.states.state.value or self.dest.states.state.value:
            if self.now_ns > LONGEST_S * 1e9:
                raise TimeoutError(f"{self.ours.transfers()}, {self.source.states}, {self.dest.states}")
            self.turn()
        assert not (*self.store.outgoing(), *self.store.incoming())

    def handler(self, way: str) -> Any:
        """Return the cfdp-py handler of a transfer."""
        return self.source if way == "up" else self.dest

    @property
    def conditions(self) -> list[int]:
        """Condition codes of the ended transfers at both ends."""
        return [*(one.condition or 0 for one in self.ours.ended), *map(int, self.user.ended.values())]

    def _arrives(self) -> bool:
        return bool(self.draw.random() >= self.loss)

    def _give(self, unit: Any) -> None:
        """Pass a data unit to the handler of its transfer.

        If the transfer has ended, send the reply that its handler would send.
        """
        if isinstance(unit, EofPdu) and unit.condition_code > CANCELLED:
            # spacepackets 0.32 leaves the condition code in the upper half of its byte.
            unit.condition_code = ConditionCode(unit.condition_code >> 4)
        if unit.direction == Direction.TOWARDS_SENDER:
            if not self.source.states.state.value:
                if isinstance(unit, FinishedPdu):
                    unit.pdu_header.pdu_conf.direction = Direction.TOWARDS_RECEIVER
                    status = TransactionStatus.TERMINATED
                    config = unit.pdu_header.pdu_conf
                    self._send(AckPdu(config, DirectiveType.FINISHED_PDU, unit.condition_code, status))
                return
            handler: Any = self.source
        else:
            if not self.dest.states.state.value and self.user.ended:
                if isinstance(unit, EofPdu):
                    self._send(acknowledge_inactive_eof_pdu(unit, TransactionStatus.TERMINATED))
                return
            handler = self.dest
        with suppress(*_IGNORED):
            handler.state_machine(unit)
        self._flush(handler)

    def _go_on(self) -> None:
        for handler in (self.source, self.dest):
            with suppress(*_IGNORED):
                handler.state_machine()
            self._flush(handler)

    def _flush(self, handler: Any) -> None:
        while handler.packets_ready:
            self._send(handler.get_next_packet().pdu)

    def _send(self, unit: Any) -> None:
        if self._arrives():
            self.ours.take(bytes(unit.pack()), self.now_ns)


@pytest.fixture
def data() -> bytes:
    return np.random.default_rng(3).bytes(SIZE)


@pytest.fixture
def file(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "file"
    path.write_bytes(data)
    return path


@pytest.fixture
def ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Ends]]:
    made: list[Ends] = []

    def make(loss: float, kind: int = MODULAR, crc: bool = False) -> Ends:
        made.append(Ends(tmp_path, monkeypatch, loss, kind, crc))
        return made[-1]

    yield make
    for one in made:
        one.ours.close(one.now_ns)


@pytest.mark.parametrize(
    ("loss", "kind", "crc"),
    [
        (0.0, MODULAR, False),
        (0.1, CRC32, True),
        (0.3, MODULAR, True),
        (0.3, CRC32C, False),
        (0.1, NO_CHECKSUM, False),
    ],
)
def test_a_file_comes_up_whole_from_cfdp_py(
    ends: Callable[..., Ends], file: Path, data: bytes, loss: float, kind: int, crc: bool
) -> None:
    pair = ends(loss, kind, crc)
    pair.put(file)
    pair.until_closed()
    assert pair.conditions == [0, 0]
    assert (pair.store.received / "up").read_bytes() == data


@pytest.mark.parametrize(
    ("loss", "kind"), [(0.0, MODULAR), (0.1, CRC32), (0.3, MODULAR), (0.3, CRC32C), (0.1, NO_CHECKSUM)]
)
def test_a_file_goes_down_whole_to_cfdp_py(
    ends: Callable[..., Ends],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    file: Path,
    data: bytes,
    loss: float,
    kind: int,
) -> None:
    monkeypatch.chdir(tmp_path)  # cfdp-py writes to the file name that the sender gave
    pair = ends(loss)
    pair.get(file, kind, tmp_path / "down")
    pair.until_closed()
    assert pair.conditions == [0, 0]
    assert (tmp_path / "down").read_bytes() == data


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("by", ["satellite", "cfdp-py"])
@pytest.mark.parametrize("way", ["up", "down"])
def test_a_cancelled_transfer_ends_cleanly_at_both_ends(
    ends: Callable[..., Ends],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    file: Path,
    way: str,
    by: str,
    loss: float,
) -> None:
    monkeypatch.chdir(tmp_path)
    pair = ends(loss)
    if way == "up":
        pair.put(file)
    else:
        pair.get(file, MODULAR, tmp_path / "down")
    while not any(one.done for one in pair.ours.transfers()) or not pair.handler(way).transaction_id:
        pair.turn()
    if by == "satellite":
        (one,) = pair.ours.transfers()
        pair.ours.cancel(one.source, one.number)
    else:
        assert pair.handler(way).cancel_request(pair.handler(way).transaction_id)
    pair.until_closed()
    assert pair.conditions == [CANCELLED, CANCELLED]
    assert not [path for path in pair.store.received.rglob("*") if path.is_file()]


@pytest.mark.parametrize("way", ["up", "down"])
def test_a_suspended_transfer_rests_and_is_whole_after_it_was_resumed(
    ends: Callable[..., Ends],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    file: Path,
    data: bytes,
    way: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    pair = ends(0.1)
    if way == "up":
        pair.put(file)
    else:
        pair.get(file, MODULAR, tmp_path / "down")
    while not any(one.done for one in pair.ours.transfers()):
        pair.turn()
    (one,) = pair.ours.transfers()
    pair.ours.suspend(one.source, one.number, suspended=True)
    pair.turn(600.0)
    (one,) = pair.ours.transfers()
    assert (one.condition, one.done < SIZE) == (None, True)
    pair.ours.suspend(one.source, one.number, suspended=False)
    pair.until_closed()
    assert pair.conditions == [0, 0]
    got = pair.store.received / "up" if way == "up" else tmp_path / "down"
    assert got.read_bytes() == data
