"""Yamcs archives and commands a simulated flight through the authenticated link.

The study flies in real time with link, gateway and Yamcs. It prints one JSON line for each check. Yamcs must
load the XTCE without a warning. Every kind of command must complete, and a refused command must be reported.
The archive must hold every packet of the flight log, byte for byte. Yamcs must decode the same values as this
project. No process may have a socket beyond loopback. The exit status is 1 if a check fails. The study is
skipped with a message if Java or the bundle is missing.

The testbed executes all commands except those that point a satellite. With `--orbit` a satellite executes two
pointing commands, which takes minutes. With `--short` (used by CI), only the commands that complete in any
state of the flight are executed.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from flight.link.commands import crc_of
from flight.link.telemetry.definitions import LINK, PARAMETER_FIELDS, PARAMETER_KEYS, TRANSFER, VERIFICATION
from flight.link.telemetry.log import find_segments
from flight.link.telemetry.packets import LAYOUTS, Layout, PacketArray, to_text, walk
from flight.schema.reader import load
from ground.telemetry import scan
from ground.xtce import spread
from ground.yamcs import write
from knightcube.errors import UsageError
from tests.studies.command import command, say
from tests.studies.interop.sockets import beyond_loopback
from tests.support.linked_flight import LinkedFlight, free_port, linked_flight
from tests.support.xtce_fields import single_bits
from tests.support.yamcs_server import Yamcs, missing, serving, troubles

_CONFIGS = Path(__file__).resolve().parents[3] / "config"
_BROKEN = "coil-broken"
_DEADLINE_S = 120.0
"""Timeout (s) of operations that need a second on an idle machine."""


def _same_table(name: str) -> dict[str, Any]:
    """Return the arguments of the command that loads the parameter table already in use."""
    config = load(_CONFIGS / name)
    values = [
        float(getattr(getattr(config, section), key))
        for section, key in (k.split(".") for k in PARAMETER_KEYS)
    ]
    named = {field.name: value for field, value in zip(PARAMETER_FIELDS, values, strict=True)}
    return {"replaced": crc_of(values), "crc": crc_of(values), **named}


_LASTING: list[tuple[str, dict[str, Any]]] = [
    ("slew", {"q2": 0.05}),
    ("mode", {"mode": "testbed-demo"}),
    ("clear", {"event": _BROKEN}),
]
_BRIEF: list[tuple[str, dict[str, Any]]] = [
    ("ping", {"number": 7}),
    ("safe", {"reason": "end of pass"}),
    ("play", {"run": 0, "begin": 0, "end": 2}),
    ("stop-playback", {}),
    ("schedule", {"at": "2099-01-01T00:00:00", "words": "slew -0.3"}),
    ("list-schedule", {}),
    ("unschedule", {"number": 0}),
    ("list-files", {"entity": "another-ground-station", "under": ""}),
    ("dump-parameters", {}),
    ("load-parameters", _same_table("step_demo.yaml")),
]
_POINT = [("point-ground", {"latitude": 52.5, "longitude": 13.4, "roll": 90.0}), ("point-sun", {})]


@dataclass(frozen=True, slots=True)
class Plan:
    """A configuration with its sequence of commands, its faults, and the timeout (s) of each command."""

    config: str
    commands: list[tuple[str, dict[str, Any]]]
    faults: tuple[str, ...] = ()
    patience: float = _DEADLINE_S


PLANS = {
    "testbed": Plan("step_demo.yaml", [*_LASTING, *_BRIEF], ("--fault", "coil-x: open @ 45")),
    "orbit": Plan("orbit.yaml", _POINT, patience=700.0),
    "short": Plan("step_demo.yaml", [("mode", {"mode": "safe"}), *_BRIEF]),
}
_ENDED = ("TM Connection closed", "read TM socket")
"""Warnings of Yamcs when the study ends the gateway; the second appears if data are still in transit."""
_RACE = 'because "paramProcessor" is null'
"""Text of an exception in Yamcs 5.12.8: a finished verifier unsubscribes while a packet is delivered.

The packet is archived with correct values, but is not sent to displays. These exceptions are counted
separately.
"""
_LOST_S = 15.0
"""Time (s) after which a command is issued again if Yamcs has lost a report."""
_REFUSED = ("clear", {"event": "too-hot"})
_STEADY = LAYOUTS["health"].identifier.to_bytes(2, "big")
"""First bytes of the packet that the flight process writes each second once its control loop runs."""
_LINKS_OWN = {LAYOUTS[packet.name].identifier.to_bytes(2, "big") for packet in (LINK, VERIFICATION, TRANSFER)}
"""First bytes of the packets that the link process creates; flight logs do not contain them."""
_EPOCH = "2026-01-01T00:00:00"


def fly(place: Path, plan: Plan) -> bool:
    """Fly a plan under Yamcs and print the checks; return whether all pass."""
    text = (_CONFIGS / plan.config).read_text(encoding="utf-8")
    http = free_port()
    with linked_flight(place / plan.config, text, *plan.faults) as flight:
        folder = place / plan.config / "yamcs"
        write(folder, flight.gateway, http, _EPOCH, flight.keys)
        with serving(folder, http) as server:
            until(server.link_up, _DEADLINE_S)
            flight.start()
            sound = [_command(server, flight, plan), _sockets(server, flight)]
            flight.end()
            logged = set(_packets(_log(flight.run)))
            until(lambda: logged <= set(_packets(server.packets())), _DEADLINE_S)
            flight.stop()
            until(lambda: not server.link_up(), _DEADLINE_S)
            sound += [_archive(server, logged), _values(server)]
        lines = [
            line for line in troubles(server.log.read_text()) if not any(words in line for words in _ENDED)
        ]
        trouble = [line for line in lines if _RACE not in line]
    say(
        what="without a warning",
        lines=len(trouble),
        first=trouble[:3],
        races_of_yamcs=len(lines) - len(trouble),
    )
    return all(sound) and not trouble


def _command(server: Yamcs, flight: LinkedFlight, plan: Plan) -> bool:
    """Issue each kind of command, and one that the flight refuses; return whether all end as expected."""
    until(lambda: _STEADY in {packet[:2] for packet in _packets(_log(flight.run))}, _DEADLINE_S)
    ends = {}
    for name, arguments in plan.commands:
        if name == "clear":
            until(lambda: _BROKEN.encode() in _log(flight.run), plan.patience)
        history = _followed(server, name, arguments, plan.patience)
        ends[name] = history.get("CommandComplete_Status", "none")
        stages = [history.get(f"Verifier_{stage}_Status") for stage in ("Accepted", "Execution", "Complete")]
        ends[name] += "" if "NOK" not in stages else " with a stage that failed"
    refused = _followed(server, *_REFUSED, _DEADLINE_S)
    failed = refused.get("CommandComplete_Status") == "NOK"
    say(what="commands", **ends, refused=refused.get("CommandComplete_Message", "not reported"))
    return failed and all(end == "OK" for end in ends.values())


def _followed(server: Yamcs, name: str, arguments: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Issue a command; return its history when it has completed or timed out.

    If Yamcs loses a report because of its race condition (`_RACE`), the command never completes and is issued
    again.
    """
    races, begun = _races(server), time.monotonic()
    command = server.command(name, arguments)

    def is_lost() -> bool:
        return time.monotonic() > begun + _LOST_S and _races(server) > races

    def is_completed() -> bool:
        return "CommandComplete_Status" in server.history(command)

    until(lambda: is_completed() or is_lost(), seconds)
    if not is_completed() and is_lost():
        command = server.command(name, arguments)
        until(is_completed, seconds)
    return server.history(command)


def _races(server: Yamcs) -> int:
    """Return how many packets Yamcs has lost because of its race condition (`_RACE`)."""
    return sum(_RACE in line for line in troubles(server.log.read_text()))


def _sockets(server: Yamcs, flight: LinkedFlight) -> bool:
    processes = {"yamcs": server.process.pid, **{name: p.pid for name, p in flight.processes.items()}}
    found = {name: beyond_loopback(pid) for name, pid in processes.items()}
    say(what="sockets beyond loopback", **{name: sorted(sockets) for name, sockets in found.items()})
    return not any(found.values())


def _archive(server: Yamcs, logged: set[bytes]) -> bool:
    """Compare the bytes of the archive with the packets of the flight log; return whether they are equal."""
    archived = list(_packets(server.packets()))
    of_the_link = [packet for packet in archived if packet[:2] in _LINKS_OWN]
    missed = len(logged - set(archived))
    strange = len(set(archived) - logged - set(of_the_link))
    counts = {"logged": len(logged), "archived": len(archived), "of_the_link": len(of_the_link)}
    say(what="archive", **counts, missed=missed, strange=strange)
    return bool(logged) and missed == strange == 0


def _values(server: Yamcs) -> bool:
    """Compare every value that Yamcs decodes from the archived packets with our reader's."""
    fields = different = absent = 0
    packets = scan(server.packets()).packets
    for name, rows in packets.items():
        if not len(rows):
            continue
        ours = _columns(LAYOUTS[name], rows)
        theirs: dict[str, list[Any]] = {parameter: [] for parameter in ours}
        for value in server.values(list(ours)):
            theirs[value["id"]["name"].rpartition("/")[2]].append(raw_of(value["rawValue"]))
        for parameter, wanted in ours.items():
            found = theirs[parameter]
            fields += len(wanted)
            absent += abs(len(wanted) - len(found))
            different += sum(not alike(*pair) for pair in zip(wanted, found, strict=False))
    say(what="values", fields=fields, different=different, absent=absent)
    return fields > 0 and different == absent == 0


def _columns(layout: Layout, rows: PacketArray) -> dict[str, list[Any]]:
    """Return the values of each parameter of a packet's rows, by their XTCE names."""
    found: dict[str, list[Any]] = {}
    names = iter(spread(layout))
    for field in layout.packet.fields:
        column = rows[field.name]
        if field.bits:
            for bits in zip(*(single_bits(field, value) for value in column.tolist()), strict=True):
                found[next(names)[0]] = list(bits)
            continue
        for i in range(field.count):
            values = column if field.count == 1 else column[:, i]
            text = field.kind.startswith("S")
            found[next(names)[0]] = [to_text(value) for value in values] if text else values.tolist()
    return found


def raw_of(value: dict[str, Any]) -> Any:
    """Return the number or string of a value in Yamcs's JSON, where large numbers and NaN are strings."""
    kind = str(value["type"])
    if kind == "STRING":
        return value.get("stringValue", "")
    number = value[f"{kind.lower()}Value"]
    return np.float32(number) if kind == "FLOAT" else float(number) if kind == "DOUBLE" else int(number)


def alike(ours: Any, theirs: Any) -> bool:
    """Return whether two values are the same; two NaN are the same."""
    if isinstance(ours, float) and math.isnan(ours):
        return bool(np.isnan(theirs))
    return bool(ours == theirs)


def _log(run: Path) -> bytes:
    return b"".join(path.read_bytes() for path in find_segments(run, "flight"))


def _packets(data: bytes) -> Iterator[bytes]:
    return (data[begin:end] for _, begin, end in walk(data))


def until(done: Callable[[], bool], seconds: float) -> None:
    """Wait until a condition holds, with a timeout."""
    end = time.monotonic() + seconds
    while not done() and time.monotonic() < end:
        time.sleep(0.3)


@command
def main(
    place: Annotated[Path, "a folder that does not exist yet"],
    *,
    orbit: Annotated[bool, "fly the satellite instead of the testbed"] = False,
    short: Annotated[bool, "fly for less than a minute"] = False,
) -> int:
    """Fly under Yamcs; return the exit status."""
    if orbit and short:
        raise UsageError("--short: not allowed with --orbit")
    if problem := missing():
        sys.stderr.write(f"SKIPPED: {problem}\n")
        return 0
    return 0 if fly(place, PLANS["orbit" if orbit else "short" if short else "testbed"]) else 1


if __name__ == "__main__":
    sys.exit(main())
