"""Tests of `knightcube parameters`, with the parameter task of the flight at the other end of its socket."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from flight.app.cli import main
from flight.link.commands import LoadParameters, crc_of, unpack
from flight.link.telemetry.definitions import COMMAND, PARAMETER_KEYS, PARAMETERS
from flight.link.telemetry.log import Recorder
from flight.link.telemetry.packets import Packer
from flight.loop.commanding import OnboardParameters
from flight.loop.facts import EventLog, Facts, Services, Streams
from flight.schema.sections import Health, Modes
from tests.support.flights import demo_config


class Sink:
    """A log that stores nothing."""

    def write(self, packet: bytes) -> None:
        pass


class Answering:
    """The flight's end of the command socket, which answers parameter commands as the loop does."""

    def __init__(self, path: Path) -> None:
        self.modes: list[Modes] = []
        self.health: list[Health] = []
        recorder = Recorder(Sink(), Sink())
        events = EventLog(recorder.event)
        services = Services(None, None, recorder, events, Facts(events), Streams(()))  # type: ignore[arg-type]  # no clock, no jobs
        adopt_modes, adopt_health = (self.modes.append,), self.health.append
        self.task = OnboardParameters(demo_config(4.0), adopt_modes, adopt_health, None, services)
        self.task.begin(0)
        self._recorder = recorder
        self._line = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._line.bind(str(path))
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        packer = Packer()
        while data := self._line.recvfrom(4096):
            if not data[0]:
                return
            command = unpack(data[0])
            problem, more = "", b""
            if isinstance(command, LoadParameters):
                problem = self.task.load(command.by_key, command.replaced, 1)
            else:
                more = self._recorder.newest(PARAMETERS)
            fields = {"obeyed": int(not problem), "name": command.packet.name, "source": "socket", "count": 1}
            answer = packer.pack(COMMAND, 0, {**fields, "mode": 1, "text": problem})
            self._line.sendto(answer + more, data[1])

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
            line.sendto(b"", self._line.getsockname())
        self._thread.join()
        self._line.close()


@pytest.fixture
def flight(tmp_path: Path) -> Iterator[Answering]:
    answering = Answering(tmp_path / "s")
    yield answering
    answering.close()


def run(tmp_path: Path, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, object]]:
    """Run the command `parameters` with `--json`."""
    status = main(["parameters", "--to", str(tmp_path / "s"), "--json", *words])
    return status, json.loads(capsys.readouterr().out)


def test_a_changed_value_is_flown_with_the_others_as_they_were(
    flight: Answering, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, shown = run(tmp_path, capsys, "modes.tumble_rate=0.25", "health.hottest=90")
    assert (status, shown["refused"], shown["table"], shown["loads"]) == (0, "", "loaded", 1)
    assert flight.modes[-1] == replace(demo_config(4.0).modes, tumble_rate=0.25)
    assert flight.health[-1].hottest == 90.0


def test_a_saved_table_is_loaded_again_as_a_whole(
    flight: Answering, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved = tmp_path / "table.yaml"
    run(tmp_path, capsys, "--save", str(saved))
    run(tmp_path, capsys, "modes.hold_error=0.3")
    status, shown = run(tmp_path, capsys, "--load", str(saved))
    assert (status, shown["loads"]) == (0, 2)
    assert flight.modes[-1] == demo_config(4.0).modes
    saved.write_text(saved.read_text().replace("hold_error", "#"))
    assert main(["parameters", "--to", str(tmp_path / "s"), "--load", str(saved)]) == 2
    assert "modes.hold_error is missing: give all parameters of the table" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("number", "shown"), [("1" + 400 * "0", "1" + 19 * "0"), (".inf", "inf"), (".nan", "nan")]
)
def test_a_table_with_an_infinite_number_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], number: str, shown: str
) -> None:
    table = tmp_path / "table.yaml"
    table.write_text(f"modes:\n  tumble_rate: {number}\n", encoding="ascii")
    assert main(["parameters", "--to", str(tmp_path / "s"), "--load", str(table)]) == 2
    error = capsys.readouterr().err
    assert f"table.yaml:2: `modes.tumble_rate` is {shown}: must be a finite number" in error


@pytest.mark.parametrize(
    ("word", "complaint"),
    [
        (
            "modes.tumble_rat=1",
            "modes.tumble_rat: no such parameter; the parameters are modes.arrived_angle,",
        ),
        ("modes.tumble_rate=fast", "give NAME=VALUE with a number"),
        ("modes.tumble_rate=99", "modes.tumble_rate = 99 must lie within 0.001 to 10 rad/s"),
        ("modes.tumble_rate=nan", "modes.tumble_rate = nan must lie within"),
    ],
)
def test_a_mistake_is_named_with_what_would_be_right(
    flight: Answering, tmp_path: Path, capsys: pytest.CaptureFixture[str], word: str, complaint: str
) -> None:
    assert main(["parameters", "--to", str(tmp_path / "s"), word]) == 2
    assert complaint in capsys.readouterr().err
    assert not flight.modes


def test_the_table_is_printed_with_units_bounds_and_earlier_values(
    flight: Answering, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["parameters", "--to", str(tmp_path / "s"), "modes.tumble_rate=0.25"]) == 0
    lines = capsys.readouterr().out.splitlines()
    by_key = {line.split()[0]: line.split()[1:] for line in lines}
    before = demo_config(4.0).modes
    assert by_key["modes.tumble_rate"] == [
        "0.25",
        "rad/s",
        "0.001",
        "to",
        "10",
        "was",
        f"{before.tumble_rate:g}",
    ]
    assert by_key["modes.arrived_for"] == [f"{before.arrived_for:g}", "s", "0.1", "to", "600"]
    assert len(lines) == len(PARAMETER_KEYS) + 1
    crc = crc_of([*flight.task._values.values()])
    assert lines[-1] == (
        f"table {crc:08x}: loaded by command (number of loads: 1); not kept: this flight has no state folder"
    )


@pytest.mark.parametrize("timeout", ["0", "-1", "inf", "nan"])
def test_a_timeout_must_be_positive(tmp_path: Path, capsys: pytest.CaptureFixture[str], timeout: str) -> None:
    assert main(["parameters", "--to", str(tmp_path / "s"), "--timeout", timeout]) == 2
    assert "must be a positive number of seconds" in capsys.readouterr().err
