"""Tests of the commanding task: commands of channels and of the time line, their answers and reports."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from flight.link import events
from flight.link.commands import (
    ChangeMode,
    Clear,
    Command,
    CommandError,
    CommandPacker,
    DumpParameters,
    LoadParameters,
    Ping,
    Point,
    Slew,
)
from flight.link.events import Mode
from flight.link.telemetry.definitions import COMMAND, PARAMETER_FIELDS, PARAMETER_KEYS
from flight.link.telemetry.packets import HEADER_BYTES, compile_layouts, crc16, to_text
from flight.loop import facts
from flight.loop.commanding import CommandTask, command_of
from flight.loop.facts import EventLog, Facts
from flight.schema.sections import CommandStep
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget

S = 1_000_000_000
EPOCH = 7 * S
NADIR = PointingTarget(Goal.NADIR, roll=0.5)
(LAYOUT,) = compile_layouts([COMMAND]).values()


class Line:
    """A channel that delivers given datagrams, and stores the answers."""

    def __init__(self, name: str = "uplink") -> None:
        self.name = name
        self.waiting: list[tuple[bytes, Any]] = []
        self.said = ""
        self.answers: list[tuple[bytes, Any]] = []

    def poll(self) -> list[tuple[bytes, Any]]:
        waiting, self.waiting = self.waiting, []
        return waiting

    def news(self) -> str:
        said, self.said = self.said, ""
        return said

    def answer(self, data: bytes, sender: Any) -> None:
        self.answers.append((data, sender))

    def close(self) -> None: ...


class Bench:
    """The commanding task with test doubles that record the calls."""

    def __init__(self, *timeline: CommandStep, lines: int = 1) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.reports: list[tuple[Any, int, str]] = []
        self.records: list[dict[str, Any]] = []
        self.refusal = ""
        self.lines = [Line("uplink"), Line("bench")][:lines]
        log = EventLog(lambda kind, now_ns, _, text: self.reports.append((kind, now_ns, text)), throttle_ns=0)
        self.facts = Facts(log)
        services = SimpleNamespace(
            facts=self.facts,
            events=log,
            recorder=SimpleNamespace(
                epoch_ns=EPOCH, record=self._record, status=lambda: b"STATUS", newest=lambda kind: b"TABLE"
            ),
        )
        parameters = SimpleNamespace(
            begin=self._note("begin"), run=self._note("run"), load=self._note("load"), dump=self._note("dump")
        )
        self.task = CommandTask(
            cast(Any, SimpleNamespace(mode=Mode.SAFE, command=self._note("mode"))),
            cast(Any, SimpleNamespace(trust=self._note("trust"))),
            cast(Any, parameters),
            timeline,
            self.lines,
            cast(Any, services),
        )
        self._packer, self._utc = CommandPacker(), 0

    def _record(self, packet: Any, now_ns: int, **values: Any) -> None:
        assert packet is COMMAND
        self.records.append({"now_ns": now_ns, **values})

    def _note(self, name: str) -> Any:
        def called(*arguments: Any) -> str:
            self.calls.append((name, *arguments))
            return self.refusal

        return called

    def packed(self, command: Command) -> bytes:
        """Return a command as a packet with a new time."""
        self._utc += 1
        return self._packer.pack(command, self._utc)

    def run(self, now_ns: int, *commands: Command | bytes) -> None:
        """Deliver commands on the first line, and run the task."""
        for number, command in enumerate(commands):
            data = command if isinstance(command, bytes) else self.packed(command)
            self.lines[0].waiting.append((data, f"sender {number}"))
        self.calls.clear()
        self.task.run(cast(Any, SimpleNamespace(start_ns=now_ns)))

    def answered(self, number: int = -1) -> dict[str, Any]:
        """Return the fields of the packet with which an answer begins."""
        data, _ = self.lines[0].answers[number]
        (row,) = LAYOUT.array(data[: LAYOUT.length])
        return {
            field.name: to_text(row[field.name]) if field.kind.startswith("S") else row[field.name].tolist()
            for field in COMMAND.fields
        }


VALUES = tuple(0.6 * field.valid[0] + 0.4 * field.valid[1] for field in PARAMETER_FIELDS if field.valid)


@pytest.mark.parametrize(
    ("command", "call"),
    [
        (ChangeMode(Mode.DETUMBLE), ("mode", Mode.DETUMBLE, 9 * S)),
        (ChangeMode(Mode.SAFE, "why"), ("mode", Mode.SAFE, 9 * S)),
        (Slew(0.25), ("mode", Mode.SLEW, 9 * S, 0.25)),
        (Point(NADIR), ("mode", Mode.POINT, 9 * S, NADIR)),
        (DumpParameters(), ("dump", 9 * S)),
        (
            LoadParameters(77, VALUES),
            ("load", dict(zip(PARAMETER_KEYS, VALUES, strict=True)), 77, 9 * S),
        ),
        (Ping(3), None),
    ],
    ids=lambda value: type(value).__name__,
)
def test_each_command_reaches_its_receiver_with_its_values(
    command: Command, call: tuple[Any, ...] | None
) -> None:
    bench = Bench()
    bench.run(9 * S, command)
    assert bench.calls == [("run", 9 * S), *([] if call is None else [call])]
    assert bench.reports == [(events.COMMANDED, 9 * S, f"uplink: {command.text}")]
    expected = {
        "obeyed": 1,
        "name": command.packet.name,
        "source": "uplink",
        "count": 1,
        "mode": int(Mode.SAFE),
        "text": command.text,
    }
    assert bench.records == [{"now_ns": 9 * S, **expected}]
    ((_, sender),) = bench.lines[0].answers
    assert sender == "sender 0"
    answer = bench.answered()
    assert {name: answer[name] for name in ("obeyed", "name", "source", "count", "mode")} == {
        name: expected[name] for name in ("obeyed", "name", "source", "count", "mode")
    }


@pytest.mark.parametrize(
    ("command", "added"), [(Ping(1), b"STATUS"), (DumpParameters(), b"TABLE"), (Slew(0.0), b"")]
)
def test_a_ping_is_answered_with_the_status_and_a_dump_with_the_table(command: Command, added: bytes) -> None:
    bench = Bench()
    bench.run(9 * S, command)
    ((data, _),) = bench.lines[0].answers
    assert data[LAYOUT.length :] == added
    (row,) = LAYOUT.array(data[: LAYOUT.length])
    assert int(row["time_ns"]) == 2 * S, "the mission time"
    bench.refusal = "no"
    if not isinstance(command, Ping | DumpParameters):
        bench.run(10 * S, command)
        assert len(bench.lines[0].answers[-1][0]) == LAYOUT.length


def test_a_refused_command_is_reported_recorded_and_answered_with_its_reason() -> None:
    bench = Bench()
    bench.refusal = "not from here"
    bench.run(9 * S, Slew(0.25))
    text = f"{Slew(0.25)}: not from here"
    assert bench.reports == [(events.COMMAND_REFUSED, 9 * S, f"uplink: {text}")]
    assert (bench.records[0]["obeyed"], bench.records[0]["text"]) == (0, text)
    assert (bench.answered()["obeyed"], bench.answered()["text"]) == (0, text)


def test_a_command_that_raises_an_exception_is_refused_and_the_next_one_is_executed() -> None:
    bench = Bench()

    def broken(*_: Any) -> str:
        raise ZeroDivisionError("division")

    bench.task._modes = cast(Any, SimpleNamespace(mode=Mode.SAFE, command=broken))
    bench.run(9 * S, Slew(0.25), Ping(1))
    assert [kind for kind, *_ in bench.reports] == [events.COMMAND_REFUSED, events.COMMANDED]
    assert bench.records[0]["text"].endswith(": ZeroDivisionError: division")
    assert [record["count"] for record in bench.records] == [1, 2]


def test_an_identical_packet_is_executed_once_and_refused_again() -> None:
    bench = Bench()
    data = bench.packed(Slew(0.25))
    bench.run(9 * S, data)
    assert len(bench.calls) == 2
    bench.run(10 * S, data, Slew(0.25))
    assert [call[0] for call in bench.calls] == ["run", "mode"], "only the packet with another time"
    assert bench.reports[1] == (
        events.COMMAND_REFUSED,
        10 * S,
        "uplink: an identical packet was received before",
    )
    assert bench.records[1]["name"] == ""
    assert len(bench.lines[0].answers) == 3
    assert bench.answered(1)["obeyed"] == 0


def test_the_last_64_packets_are_remembered() -> None:
    bench = Bench()
    first, second = bench.packed(Ping(0)), bench.packed(Ping(1))
    bench.run(9 * S, first, second, *[Ping(number) for number in range(2, 65)])
    bench.run(10 * S, second)
    assert bench.records[-1]["obeyed"] == 0, "64 packets ago"
    bench.run(11 * S, first)
    assert bench.records[-1]["obeyed"] == 1, "65 packets ago"


def test_a_malformed_packet_is_never_answered_and_a_wrong_value_is() -> None:
    bench = Bench()
    bench.run(9 * S, b"nonsense of some length")
    assert bench.lines[0].answers == []
    ((kind, _, text),) = bench.reports
    assert (kind, text.startswith("uplink: no command begins with")) == (events.COMMAND_REFUSED, True)
    assert bench.records[0]["obeyed"] == 0
    old = bytearray(bench.packed(Ping(1)))
    old[HEADER_BYTES] = 99
    old[-2:] = crc16(bytes(old[:-2])).to_bytes(2, "big")
    bench.run(10 * S, bytes(old))
    assert len(bench.lines[0].answers) == 1
    assert bench.answered()["text"] == "version 99 of ping is not known"
    bench.run(11 * S, bytes(old))
    assert bench.answered()["text"] == "version 99 of ping is not known", "a refused packet is not remembered"


def test_each_channel_is_polled_and_its_news_are_reported() -> None:
    bench = Bench(lines=2)
    other = bench.lines[1]
    other.waiting, other.said = [(bench.packed(Ping(5)), "there")], "the socket is bound again"
    bench.run(9 * S, Ping(4))
    assert (events.COMMAND_SOCKET, 9 * S, "the socket is bound again") in bench.reports
    assert [record["source"] for record in bench.records] == ["uplink", "bench"]
    assert [len(line.answers) for line in bench.lines] == [1, 1]
    assert other.answers[0][1] == "there"


def test_the_time_line_is_executed_in_order_when_it_is_due() -> None:
    """The steps of the time line are executed in the order of their mission times."""
    bench = Bench(CommandStep(at=3.0, slew=0.25), CommandStep(at=2.0, mode="detumble"))
    bench.run(EPOCH + 2 * S - 1)
    assert bench.records == []
    bench.run(EPOCH + 2 * S)
    assert bench.calls == [("run", 9 * S), ("mode", Mode.DETUMBLE, 9 * S)]
    bench.run(EPOCH + 4 * S)
    assert bench.calls == [("run", 11 * S), ("mode", Mode.SLEW, 11 * S, 0.25)]
    bench.run(EPOCH + 5 * S)
    assert bench.calls == [("run", 12 * S)], "each step is executed once"
    assert [record["source"] for record in bench.records] == ["timeline", "timeline"]
    assert bench.lines[0].answers == [], "nobody waits for an answer"


def test_several_steps_that_are_due_are_executed_in_the_same_cycle() -> None:
    bench = Bench(CommandStep(at=1.0, slew=0.1), CommandStep(at=2.0, slew=0.2))
    bench.run(EPOCH + 2 * S)
    assert [call[-1] for call in bench.calls[1:]] == [0.1, 0.2]


def test_the_parameters_begin_with_the_task() -> None:
    bench = Bench()
    bench.task.begin(5)
    assert bench.calls == [("begin", 5)]


def test_clearing_a_broken_coil_makes_the_drive_trust_its_coils_again() -> None:
    bench = Bench()
    bench.facts.update(facts.COILS_BROKEN[1], True, 0, "no current")
    bench.facts.update(facts.TASK_FAILING, True, 0, "often")
    bench.run(9 * S, Clear("camera-lost"))
    refused = bench.records[-1]
    assert refused["obeyed"] == 0
    named = f"{events.TASK_FAILING.name}, {events.COIL_BROKEN.name}"
    assert refused["text"].endswith(f"no event is latched as 'camera-lost'; latched: {named}")
    bench.run(10 * S, Clear(events.TASK_FAILING.name))
    assert bench.records[-1]["obeyed"] == 1
    assert [call[0] for call in bench.calls] == ["run"]
    bench.run(11 * S, Clear(events.COIL_BROKEN.name))
    assert bench.calls == [("run", 11 * S), ("trust", 11 * S)]
    assert bench.facts.held() == ()
    bench.run(12 * S, Clear(events.COIL_BROKEN.name))
    assert bench.calls == [("run", 12 * S)]
    assert bench.records[-1]["text"].endswith("latched: nothing")


def test_a_condition_that_does_not_latch_is_not_cleared_or_named() -> None:
    bench = Bench()
    bench.facts.update(facts.CAMERA_LOST, True, 0, "no frame")
    bench.run(9 * S, Clear(events.TASK_FAILING.name))
    assert bench.records[-1]["text"].endswith("latched: nothing")


@pytest.mark.parametrize(
    ("step", "command"),
    [
        (CommandStep(at=1.0, mode="detumble"), ChangeMode(Mode.DETUMBLE)),
        (CommandStep(at=1.0, slew=-0.25), Slew(-0.25)),
        (
            CommandStep(at=1.0, point="nadir", roll_deg=90.0),
            Point(PointingTarget(Goal.NADIR, roll=1.5707963267948966)),
        ),
        (CommandStep(at=1.0, clear="too-hot"), Clear("too-hot")),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_step_of_the_time_line_is_one_command(step: CommandStep, command: Command) -> None:
    assert command_of(step) == command


@pytest.mark.parametrize("given", [{}, {"slew": 0.1, "clear": "too-hot"}])
def test_a_step_without_a_command_or_with_two_is_refused(given: dict[str, Any]) -> None:
    with pytest.raises(
        CommandError, match=f"at 2.5 s: give one of mode, slew, point, clear; {len(given)} are"
    ):
        command_of(CommandStep(at=2.5, **given))
