"""Commanding: executes and answers the commands that arrive on channels or are due on the time line.

The dispatcher is one of the documented containment boundaries: no command can end the control loop.

A command that loads parameters replaces the whole table of onboard parameters. The new table is stored for
later boots. Before a table takes effect, its values are checked against their ranges and against the bounds
of the configuration.
If a flight ends uncleanly, or restarts the process, within `PROVEN_NS` after a load, the next boot uses the
previous table (`flight.loop.state`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import msgspec

from flight.link import events
from flight.link.commands import (
    DUMP_PARAMETERS,
    PING,
    ChangeMode,
    Channel,
    Clear,
    Command,
    CommandError,
    DumpParameters,
    LoadParameters,
    MalformedError,
    Ping,
    Point,
    Slew,
    crc_of,
    problem_of,
    unpack,
)
from flight.link.events import Mode
from flight.link.telemetry.definitions import COMMAND, PARAMETER_FIELDS, PARAMETER_KEYS, PARAMETERS
from flight.link.telemetry.packets import Packer
from flight.loop.executive import Cycle
from flight.loop.facts import Services
from flight.loop.modes import ModeControl
from flight.loop.state import KeptTable, StateKeeper
from flight.loop.steering import CoilDrive
from flight.schema.sections import CommandStep, Config, Health, Modes

S = TypeVar("S", Modes, Health)

PROVEN_NS = 60_000_000_000
"""Flight time (ns) after which a loaded table is kept even if the flight then ends uncleanly."""


class OnboardParameters:
    """The table of onboard parameters in use."""

    def __init__(
        self,
        config: Config,
        adopt_modes: Sequence[Callable[[Modes], None]],
        adopt_health: Callable[[Health], None],
        keeper: StateKeeper | None,
        services: Services,
    ) -> None:
        """Start with the configured or stored table; the functions `adopt_...` pass new limits to tasks."""
        self._config = config
        self._adopt_modes, self._adopt_health = adopt_modes, adopt_health
        self._keeper, self._recorder, self._events = keeper, services.recorder, services.events
        self._configured = {key: float(_value(config, key)) for key in PARAMETER_KEYS}
        self._values: Mapping[str, float] = self._configured
        self._table = KeptTable() if keeper is None else keeper.table
        self._loaded_ns = 0

    def begin(self, now_ns: int) -> None:
        """Apply the stored table if software and configuration permit it, and record the table in use."""
        self._loaded_ns = now_ns
        if kept := self._table.values:
            # Keys that the stored table lacks, because another version wrote it, get their configured values.
            table = {key: kept.get(key, value) for key, value in self._configured.items()}
            if problem := problem_of(table) or self._adopt(table):
                self._table = msgspec.structs.replace(self._table, values={}, proven=True)
                self._events.report(events.PARAMETERS_LEFT, now_ns, problem)
        self.dump(now_ns)

    def run(self, now_ns: int) -> None:
        """Mark a table as proven when it has been in use for `PROVEN_NS`."""
        if not self._table.proven and now_ns - self._loaded_ns >= PROVEN_NS:
            self._keep(msgspec.structs.replace(self._table, proven=True))

    def leave_unproven(self, now_ns: int) -> None:
        """Let the next boot use the previous table unless the table is proven; called before a restart."""
        if not self._table.proven:
            before = self._table.before
            self._keep(msgspec.structs.replace(self._table, values=before, before={}, proven=True))
            text = "the table had just been loaded when the flight had to be restarted"
            self._events.report(events.PARAMETERS_LEFT, now_ns, text)

    def load(self, values: Mapping[str, float], replaced: int, now_ns: int) -> str:
        """Replace the table, which has the CRC `replaced`, by `values`; return why this is refused, or ""."""
        if replaced != self._crc:
            return f"the table in use has CRC {self._crc:08x}, not {replaced:08x}: dump and check it again"
        before = self._table.values if self._table.proven else self._table.before
        if problem := problem_of(values) or self._adopt(values):
            return problem
        self._loaded_ns = now_ns
        self._keep(
            KeptTable(values=dict(values), before=dict(before), proven=False, loads=self._table.loads + 1)
        )
        self.dump(now_ns)
        return ""

    def dump(self, now_ns: int) -> None:
        """Record the table in use as a packet."""
        named = {
            field.name: self._values[key] for field, key in zip(PARAMETER_FIELDS, PARAMETER_KEYS, strict=True)
        }
        fields: dict[str, Any] = {
            "loads": self._table.loads,
            "crc": self._crc,
            "table": int(self._values is not self._configured),
            "kept": int(self._keeper is not None),
        }
        self._recorder.record(PARAMETERS, now_ns, **fields, **named)

    @property
    def _crc(self) -> int:
        return crc_of([self._values[key] for key in PARAMETER_KEYS])

    def _keep(self, table: KeptTable) -> None:
        self._table = table
        if self._keeper is not None:
            self._keeper.note_table(table)

    def _adopt(self, values: Mapping[str, float]) -> str:
        """Pass a table to all tasks that use it; return why the schema rejects it, or an empty text."""
        try:
            modes = _section(self._config.modes, "modes", values)
            health = _section(self._config.health, "health", values)
        except msgspec.ValidationError as error:
            return str(error)
        self._values = values
        for adopt in self._adopt_modes:
            adopt(modes)
        self._adopt_health(health)
        return ""


def _value(config: Config, key: str) -> Any:
    section, _, name = key.partition(".")
    return getattr(getattr(config, section), name)


def _section(section: S, name: str, values: Mapping[str, float]) -> S:
    """Return a configuration section in which the values of a table replace the configured values.

    Raises ValidationError for values that the schema rejects.
    """
    changes = {key.partition(".")[2]: value for key, value in values.items() if key.startswith(f"{name}.")}
    return msgspec.convert({**msgspec.to_builtins(section), **changes}, type(section))


_REMEMBERED = 64


class CommandTask:
    """Task of the command rate group: executes commands and sends the answers."""

    def __init__(
        self,
        modes: ModeControl,
        drive: CoilDrive,
        parameters: OnboardParameters,
        timeline: Sequence[CommandStep],
        channels: Sequence[Channel],
        services: Services,
    ) -> None:
        self._modes, self._drive, self._parameters = modes, drive, parameters
        self._timeline = deque(sorted(timeline, key=lambda step: step.at))
        self._channels, self._facts, self._recorder = channels, services.facts, services.recorder
        self._events = services.events
        self._answers = Packer()
        self._received: deque[bytes] = deque(maxlen=_REMEMBERED)
        self._count = 0

    def begin(self, now_ns: int) -> None:
        """Apply the parameters that an earlier boot stored."""
        self._parameters.begin(now_ns)

    def end(self, now_ns: int, *, restarts: bool) -> None:
        """End the flight; a table that may be the cause of a restart is not used by the next boot."""
        if restarts:
            self._parameters.leave_unproven(now_ns)

    def run(self, cycle: Cycle) -> None:
        """Execute the commands that have arrived or are due on the time line."""
        now_ns = cycle.start_ns
        self._parameters.run(now_ns)
        while self._timeline and self._timeline[0].at <= (now_ns - self._recorder.epoch_ns) * 1e-9:
            self._conclude("timeline", command_of(self._timeline.popleft()), "", now_ns)
        for channel in self._channels:
            received = channel.poll()
            if news := channel.news():
                self._events.report(events.COMMAND_SOCKET, now_ns, news)
            for data, sender in received:
                fields, well_formed = self._execute(channel.name, data, now_ns)
                if not well_formed:
                    continue
                answer = self._answers.pack(COMMAND, now_ns - self._recorder.epoch_ns, fields)
                if fields["obeyed"] and fields["name"] == PING.name:
                    answer += self._recorder.status()
                elif fields["obeyed"] and fields["name"] == DUMP_PARAMETERS.name:
                    answer += self._recorder.newest(PARAMETERS)
                channel.answer(answer, sender)

    def _execute(self, source: str, data: bytes, now_ns: int) -> tuple[dict[str, Any], bool]:
        """Execute a datagram; return the fields of the answer, and whether the datagram is well-formed."""
        command: Command | None = None
        problem = ""
        well_formed = True
        if data in self._received:
            problem = "an identical packet was received before"
        else:
            try:
                command = unpack(data)
                self._received.append(data)
            except CommandError as error:
                problem = str(error)
                well_formed = not isinstance(error, MalformedError)
        return self._conclude(source, command, problem, now_ns), well_formed

    def _conclude(self, source: str, command: Command | None, problem: str, now_ns: int) -> dict[str, Any]:
        """Execute a command if no `problem` was found before, then report and record the result."""
        self._count += 1
        if command is not None and not problem:
            try:
                problem = self._obey(command, now_ns)
            except Exception as error:  # noqa: BLE001 - containment boundary: the command dispatcher
                problem = f"{type(error).__name__}: {error}"
        text = command.text if command is not None else ""
        report = ": ".join(part for part in (text, problem) if part)
        self._events.report(
            events.COMMAND_REFUSED if problem else events.COMMANDED, now_ns, f"{source}: {report}"
        )
        fields = {
            "obeyed": int(not problem),
            "name": command.packet.name if command is not None else "",
            "source": source,
            "count": self._count,
            "mode": int(self._modes.mode),
            "text": report,
        }
        self._recorder.record(COMMAND, now_ns, **fields)
        return fields

    def _obey(self, command: Command, now_ns: int) -> str:
        """Execute a command, and return why it is rejected, or an empty text."""
        problem = ""
        match command:
            case Ping():
                pass
            case ChangeMode(mode):
                problem = self._modes.command(mode, now_ns)
            case Slew(wanted):
                problem = self._modes.command(Mode.SLEW, now_ns, wanted)
            case Clear(event):
                problem = self._clear(event, now_ns)
            case Point(target):
                problem = self._modes.command(Mode.POINT, now_ns, target)
            case LoadParameters(replaced):
                problem = self._parameters.load(command.by_key, replaced, now_ns)
            case DumpParameters():
                self._parameters.dump(now_ns)
        return problem

    def _clear(self, event: str, now_ns: int) -> str:
        if not self._facts.clear(event):
            latched = [fact.begins.name for fact in self._facts.held() if fact.latching]
            return f"no event is latched as {event!r}; latched: {', '.join(latched) or 'nothing'}"
        if event == events.COIL_BROKEN.name:
            self._drive.trust(now_ns)
        return ""


def command_of(step: CommandStep) -> Command:
    """Return the command of a step of the time line. Raises CommandError unless the step has exactly one."""
    found: list[Command] = []
    if step.mode is not None:
        found.append(ChangeMode(Mode.named(step.mode)))
    if step.slew is not None:
        found.append(Slew(step.slew))
    if step.point is not None:
        found.append(Point(step.target_at(step.point)))
    if step.clear is not None:
        found.append(Clear(step.clear))
    if len(found) != 1:
        raise CommandError(f"at {step.at:g} s: give one of mode, slew, point, clear; {len(found)} are given")
    return found[0]
