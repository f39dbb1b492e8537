"""Tests that a loaded table is kept after its confirmation, and replaced by the former table otherwise."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from flight.link import events
from flight.link.commands import crc_of
from flight.link.telemetry.definitions import PARAMETER_KEYS
from flight.loop.commanding import OnboardParameters
from flight.loop.facts import EventLog
from flight.loop.state import KeptTable, StateStore
from flight.schema import reader as configuration
from flight.schema.sections import Modes
from tests.support.flights import Rigged, demo_config, event_names, fly

MINUTE_NS = 60_000_000_000


class Board:
    """Onboard parameters with test doubles of state keeper and recorder, which store the passed values."""

    def __init__(self, table: KeptTable | None = None, keeps: bool = True) -> None:
        self.noted: list[KeptTable] = []
        self.modes: list[Modes] = []
        self.records: list[dict[str, Any]] = []
        self.events: list[str] = []
        keeper = SimpleNamespace(table=table or KeptTable(), note_table=self.noted.append)
        recorder = SimpleNamespace(record=lambda packet, now_ns, **values: self.records.append(values))
        log = EventLog(lambda kind, *_: self.events.append(kind.name), throttle_ns=0)
        self.parameters = OnboardParameters(
            demo_config(4.0),
            (self.modes.append,),
            lambda health: None,
            cast(Any, keeper) if keeps else None,
            cast(Any, SimpleNamespace(recorder=recorder, events=log)),
        )

    def values(self, **changes: float) -> dict[str, float]:
        """Return the values of the active table with some changes."""
        return {
            **self.parameters._values,
            **{key.replace("__", "."): value for key, value in changes.items()},
        }

    def load(self, now_ns: int = 5, **changes: float) -> str:
        """Load a table that differs from the active table by the given changes."""
        return self.parameters.load(self.values(**changes), self.records[-1]["crc"], now_ns)


def begun(table: KeptTable | None = None, keeps: bool = True) -> Board:
    """Return a board whose parameter task started at the time 5 ns."""
    board = Board(table, keeps)
    board.parameters.begin(5)
    return board


@pytest.mark.parametrize(("flown_ns", "proven"), [(MINUTE_NS - 1, False), (MINUTE_NS, True)])
def test_a_table_is_proven_after_a_minute(flown_ns: int, proven: bool) -> None:
    board = begun()
    assert board.load(7, modes__tumble_rate=0.25) == ""
    board.parameters.run(7 + flown_ns)
    assert [table.proven for table in board.noted] == ([False, True] if proven else [False])
    board.parameters.run(7 + 2 * MINUTE_NS)
    board.parameters.run(7 + 3 * MINUTE_NS)
    assert [table.proven for table in board.noted] == [False, True], "it is stored once"


def test_a_restart_of_the_flight_leaves_a_table_that_is_not_proven() -> None:
    """A memory limit below the flight's memory would otherwise restart every later flight."""
    board = begun()
    board.load(7, modes__tumble_rate=0.25)
    board.parameters.run(7 + MINUTE_NS)
    board.parameters.leave_unproven(8 + MINUTE_NS)
    assert board.events == []
    board.load(9 + MINUTE_NS, health__memory=1e6)
    board.parameters.leave_unproven(10 + MINUTE_NS)
    assert board.events == ["parameters-left"]
    assert board.noted[-1].values["modes.tumble_rate"] == 0.25
    assert board.noted[-1].values["health.memory"] == demo_config(4.0).health.memory
    assert (board.noted[-1].proven, board.noted[-1].loads) == (True, 2)


def test_the_table_before_an_unproven_one_is_the_last_proven_one() -> None:
    board = begun()
    board.load(7, modes__tumble_rate=0.25)
    board.load(8, modes__tumble_rate=0.3)
    assert [dict(table.before) for table in board.noted] == [{}, {}]
    board.parameters.run(8 + MINUTE_NS)
    board.load(9 + MINUTE_NS, modes__tumble_rate=0.35)
    assert board.noted[-1].before["modes.tumble_rate"] == 0.3
    assert [table.loads for table in board.noted] == [1, 2, 2, 3]


def test_the_packet_has_the_source_the_crc_and_the_number_of_loads() -> None:
    board = begun()
    first = board.records[0]
    assert (first["loads"], first["table"], first["kept"]) == (0, 0, 1)
    board.load(modes__tumble_rate=0.25)
    second = board.records[-1]
    assert (second["loads"], second["table"], second["modes_tumble_rate"]) == (1, 1, 0.25)
    assert second["crc"] == crc_of([board.values()[key] for key in PARAMETER_KEYS])
    assert begun(keeps=False).records[0]["kept"] == 0


def test_a_table_instead_of_another_one_or_with_a_wrong_value_is_refused() -> None:
    board = begun()
    assert "dump and check it again" in board.parameters.load(board.values(), board.records[-1]["crc"] ^ 1, 6)
    assert "must lie within" in board.load(modes__tumble_rate=99.0)
    assert board.modes == []
    assert board.noted == []
    assert len(board.records) == 1


def test_a_stored_table_is_used_again_with_missing_keys_from_the_configuration() -> None:
    board = begun(KeptTable(values={"modes.tumble_rate": 0.25}, loads=4, proven=True))
    assert board.modes[-1].tumble_rate == 0.25
    assert board.modes[-1].hold_error == demo_config(4.0).modes.hold_error
    assert (board.records[0]["table"], board.records[0]["loads"]) == (1, 4)
    assert board.events == []


def test_a_stored_table_that_is_invalid_now_is_left_and_reported() -> None:
    board = begun(KeptTable(values={"modes.tumble_rate": 99.0}, loads=4, proven=False))
    assert board.modes == []
    assert board.events == ["parameters-left"]
    assert (board.records[0]["table"], board.records[0]["loads"]) == (0, 4)
    board.parameters.run(5 + MINUTE_NS)
    assert board.noted == [], "there is nothing to prove"


def test_a_flight_that_restarts_the_process_soon_after_a_load_stores_the_previous_table(
    tmp_path: Path,
) -> None:
    config = demo_config(3.0, camera=False)
    kept = configuration.replace(config.state, folder=str(tmp_path / "state"))
    socket = configuration.replace(config.commands, socket=str(tmp_path / "commands"))

    def prepare(rigged: Rigged) -> None:
        parameters = cast(Any, rigged.loop)._tasks.commanding._parameters
        table = {**parameters._values, "health.memory": 1e6}
        rigged.at(1.0, lambda: parameters.load(table, parameters._crc, rigged.lock.clock.now_ns()))
        report = cast(Any, rigged.loop)._services.events.report
        rigged.at(1.5, lambda: report(events.MEMORY_HIGH, rigged.lock.clock.now_ns(), "2 MB"))

    run = fly(configuration.replace(config, state=kept, commands=socket), tmp_path / "run", prepare)
    assert event_names(run)[-2:] == ["parameters-left", "stopped"]
    stored = StateStore(tmp_path / "state", lambda *_: None).load()
    assert (stored.running, stored.table) == (False, KeptTable(loads=1))
