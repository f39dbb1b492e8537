"""Commanding: executes commands from channels and from the time line, and answers them.

The dispatcher is one of the named containment boundaries: no command can end the loop.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flight.link import events
from flight.link.commands.channel import Channel
from flight.link.commands.codec import unpack
from flight.link.commands.definitions import DUMP_PARAMETERS, PING
from flight.link.commands.errors import CommandError, MalformedError
from flight.link.commands.values import (
    ChangeMode,
    Clear,
    Command,
    DumpParameters,
    LoadParameters,
    Ping,
    Point,
    Slew,
)
from flight.link.modes import Mode
from flight.link.telemetry.definitions import COMMAND, PARAMETERS
from flight.link.telemetry.packets import Packer
from flight.loop.executive.rate_group import Cycle
from flight.loop.services import Services
from flight.loop.tasks.coil_drive import CoilDrive
from flight.loop.tasks.mode_control import ModeControl
from flight.loop.tasks.parameters import Parameters
from flight.schema.sections import CommandStep

_REMEMBERED = 64


@dataclass(frozen=True, slots=True)
class Obeying:
    """The tasks that obey commands."""

    modes: ModeControl
    drive: CoilDrive
    parameters: Parameters


class Commanding:
    """The task of the commands' rate group."""

    def __init__(
        self,
        obeying: Obeying,
        timeline: Sequence[CommandStep],
        channels: Sequence[Channel],
        services: Services,
    ) -> None:
        self._modes = obeying.modes
        self._drive = obeying.drive
        self._parameters = obeying.parameters
        self._timeline = deque(sorted(timeline, key=lambda step: step.at))
        self._channels = channels
        self._facts = services.facts
        self._recorder = services.recorder
        self._events = services.events
        self._answers = Packer()
        self._seen: deque[bytes] = deque(maxlen=_REMEMBERED)
        self._count = 0

    def begin(self, now_ns: int) -> None:
        """Fly the parameters that an earlier boot kept."""
        self._parameters.begin(now_ns)

    def run(self, cycle: Cycle) -> None:
        """Execute the commands that are due or have arrived."""
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
                mission_ns = now_ns - self._recorder.epoch_ns
                channel.answer(self._answers.pack(COMMAND, mission_ns, fields) + self._asked(fields), sender)

    def _asked(self, fields: Mapping[str, Any]) -> bytes:
        """Return the packets that a command asked for."""
        if fields["obeyed"] and fields["name"] == PING.name:
            return self._recorder.status()
        if fields["obeyed"] and fields["name"] == DUMP_PARAMETERS.name:
            return self._recorder.newest(PARAMETERS)
        return b""

    def _execute(self, source: str, data: bytes, now_ns: int) -> tuple[dict[str, Any], bool]:
        """Execute a datagram; return the fields of the answer, and whether it is a packet of a command."""
        command: Command | None = None
        problem = ""
        well_formed = True
        if data in self._seen:
            problem = "the very same packet has come before"
        else:
            try:
                command = unpack(data)
                self._seen.append(data)
            except CommandError as error:
                problem = str(error)
                well_formed = not isinstance(error, MalformedError)
        return self._conclude(source, command, problem, now_ns), well_formed

    def _conclude(self, source: str, command: Command | None, problem: str, now_ns: int) -> dict[str, Any]:
        """Execute a command, unless there is a `problem`; report and record the result."""
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
        """Execute a command; return why it was refused, empty when done."""
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
            return f"nothing is latched under {event!r}; latched: {', '.join(latched) or 'nothing'}"
        if event == events.COIL_BROKEN.name:
            self._drive.trust(now_ns)
        return ""


def command_of(step: CommandStep) -> Command:
    """Return the command of a step of a time line. Raises CommandError unless it is exactly one."""
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
