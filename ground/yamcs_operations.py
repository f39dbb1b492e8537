"""Content of Yamcs for operations: command stacks, a display, and passes on the timeline.

A command stack is a file of Yamcs that lists commands and conditions. Yamcs executes the steps in order, and
stops at the first condition that is not satisfied in time.
"""

from __future__ import annotations

import base64
import json
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

from flight.link.commands import Point, words_of
from flight.link.telemetry.packets import LAYOUTS
from ground.console.description import foreign_modes, layouts_for
from ground.xtce import SPACE, TELECOMMANDS, UNUSED, spread

if TYPE_CHECKING:
    from ground.console.description import Body
    from ground.passes import OrbitPrediction, Pass, Station

STACKS, DISPLAYS = "stacks", "displays"
"""Names of the buckets in which Yamcs's page looks for command stacks and displays."""
PASS = "pass"
"""Tag that marks a timeline item as a pass."""
_VERIFY_MS = 10_000
"""Longest time (ms) to wait until a condition is satisfied; the packet `health` arrives every second."""
_SCHEMA = "https://yamcs.org/schema"
_REQUEST_S = 300.0
_PAGE = 500  # maximum number of timeline items in one answer


def _command(name: str, **arguments: object) -> dict[str, Any]:
    listed = [{"name": key, "value": value} for key, value in arguments.items()]
    return {"type": "command", "name": f"/{SPACE}/{name}", "arguments": listed}


def _mode(operator: str, mode: str) -> dict[str, Any]:
    """Return the condition that the satellite's mode equals ("eq") or differs from ("neq") `mode`."""
    condition = {"parameter": f"/{SPACE}/health_mode", "operator": operator, "value": mode}
    return {"type": "verify", "condition": [condition], "delay": 0, "timeout": _VERIFY_MS}


_PROCEDURES: Mapping[str, Sequence[dict[str, Any]]] = {
    "check-health": (
        _command("ping", number=1),
        _mode("neq", "safe"),
        _command("dump-parameters"),
        _command("list-schedule"),
    ),
    "enter-safe": (_command("safe", reason="command stack"), _mode("eq", "safe")),
    "leave-safe-to-hold": (_mode("eq", "safe"), _command("mode", mode="hold"), _mode("eq", "hold")),
    "leave-safe-to-point": (_mode("eq", "safe"), _command("mode", mode="point"), _mode("neq", "safe")),
    "slew-to-zero": (_mode("neq", "safe"), _command("slew", q2=0.0), _mode("eq", "hold")),
    "detumble": (_mode("neq", "safe"), _command("mode", mode="detumble"), _mode("neq", "safe")),
    "list-files": (_command("list-files", entity="another-ground-station", under=""),),
}
"""Steps of each procedure by its name. After the command for mode `point`, mode `acquire` may come first."""


def procedures_of(body: Body | None) -> Mapping[str, Sequence[dict[str, Any]]]:
    """Return the steps of each procedure for a kind of body; all procedures if the body is not known."""
    known = {f"/{SPACE}/{name}" for name in layouts_for(body, TELECOMMANDS)}
    foreign = {mode.label for mode in foreign_modes(body)}

    def obeyed(step: dict[str, Any]) -> bool:
        values = {one["value"] for one in (*step.get("arguments", ()), *step.get("condition", ()))}
        return step.get("name", min(known)) in known and not values & foreign

    return {name: steps for name, steps in _PROCEDURES.items() if all(map(obeyed, steps))}


def stacks_and_displays(body: Body | None = None) -> Mapping[str, str]:
    """Return the content of each command stack and display by its name, for a kind of body."""
    found: dict[str, str] = {}
    advancement = {"acknowledgment": "CommandComplete", "wait": 0}
    for name, steps in procedures_of(body).items():
        stack = {
            "$schema": f"{_SCHEMA}/command-stack.schema.json",
            "steps": steps,
            "advancement": advancement,
        }
        found[f"{STACKS}/{name}.ycs"] = json.dumps(stack, indent=2) + "\n"
    shown = [f"/{SPACE}/{name}" for name, _ in spread(LAYOUTS["health"]) if not name.endswith(UNUSED)]
    display = {"$schema": f"{_SCHEMA}/parameter-table.schema.json", "scroll": False, "parameters": shown}
    found[f"{DISPLAYS}/health.par"] = json.dumps(display, indent=2) + "\n"
    return found


@dataclass(frozen=True, slots=True)
class Session:
    """Access to the HTTP interface of a running Yamcs.

    Attributes:
        url: address of the interface, such as `http://127.0.0.1:8090/api`.
        user: name of the user.
        password: password of the user.
    """

    url: str
    user: str
    password: str

    def ask(self, path: str, body: Mapping[str, Any] | None = None, method: str | None = None) -> Any:
        """Return the answer to GET, to POST of a body, or to another method. Raises OSError."""
        data = None if body is None else json.dumps(body).encode()
        secret = base64.b64encode(f"{self.user}:{self.password}".encode()).decode()
        headers = {"Content-Type": "application/json", "Authorization": f"Basic {secret}"}
        request = urllib.request.Request(self.url + path, data, headers, method=method)
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(request, timeout=_REQUEST_S) as answer:
            return json.loads(answer.read())


def add_passes(
    session: Session, instance: str, prediction: OrbitPrediction, stations: Sequence[Station]
) -> None:
    """Show the predicted passes on the timeline, and delete earlier predictions of the same span.

    A view of the timeline is added at the first call. Raises OSError if Yamcs refuses a request.
    """
    timeline = f"/timeline/{instance}"
    if not session.ask(f"{timeline}/views").get("views"):
        common = {"shared": True, "source": "rdb"}
        ruler = {**common, "name": "UTC", "type": "TIME_RULER", "properties": {"timezone": "UTC"}}
        band = {**common, "name": "passes", "type": "ITEM_BAND", "tags": [PASS]}
        bands = [session.ask(f"{timeline}/bands", one)["id"] for one in (ruler, band)]
        session.ask(f"{timeline}/views", {"name": "passes", "bands": bands})
    for old in list(_shown(session, timeline, prediction)):
        session.ask(f"{timeline}/items/{old}", method="DELETE")
    for one in prediction.passes(stations):
        session.ask(f"{timeline}/items", _item(one))


def _shown(session: Session, timeline: str, prediction: OrbitPrediction) -> Iterator[str]:
    """Yield the identifiers of the passes on the timeline in the span of a prediction."""
    query = {"start": prediction.begin.isoformat(), "stop": prediction.end.isoformat(), "limit": str(_PAGE)}
    while True:
        found = session.ask(f"{timeline}/items?{urlencode(query)}")
        yield from (item["id"] for item in found.get("items", ()) if PASS in item.get("tags", ()))
        if "continuationToken" not in found:
            return
        query["next"] = found["continuationToken"]


def _item(one: Pass) -> dict[str, Any]:
    """Return a pass as a timeline item, with sunlight or shadow, and arguments for the command `schedule`."""
    from ground.passes import scheduled_targets  # noqa: PLC0415 - Skyfield is large

    begin = one.rise.replace(microsecond=0)
    azimuths = " to ".join(f"{azimuth:.0f}" for azimuth in one.azimuths_deg)
    light = "sunlight" if one.sunlit > 0.5 else "shadow"
    words = [f"{at:%Y-%m-%dT%H:%M:%S} {words_of(Point(target))}" for at, target in scheduled_targets(one)]
    facts = [
        f"azimuths {azimuths} deg",
        f"satellite in {light}",
        f"Sun {one.sun_elevation_deg:.0f} deg high",
        *(f"schedule {line}" for line in words),
    ]
    return {
        "source": "rdb",
        "type": "EVENT",
        "name": f"{one.station.name}, {one.elevation_deg:.0f} deg",
        "start": begin.isoformat(),
        "duration": f"{(one.set - begin).total_seconds():.0f}s",
        "tags": [PASS],
        "description": "; ".join(facts),
    }
