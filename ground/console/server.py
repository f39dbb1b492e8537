"""Serves the page, the telemetry of one flight, and the commands of the page's forms; on loopback only."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

from aiohttp import WSMsgType, web

from flight.link.telemetry.definitions import LINK, TRANSFER, VERIFICATION
from flight.link.telemetry.packets import LAYOUTS, PacketArray, TelemetryError
from ground.console.access import Access, foreign
from ground.console.commanding import Commanding
from ground.console.cursor import Cursor
from ground.console.history import History
from ground.console.instant import Instant
from ground.console.kept_frames import FrameFolder
from ground.console.surroundings import Surroundings
from ground.documentation import command_table, database
from knightcube.errors import FlightError, UsageError

PAGE = Path(__file__).parent / "page"
PUSH_S = 0.1
NO_ACCESS = "open the newest address that `flight console` printed: the page needs the token in it"
_LOOK_S = 0.1
_MOST_POINTS = 4000
_OF_THE_LINK = frozenset({LINK.name, VERIFICATION.name, TRANSFER.name})
"""Packets that come also while the flight itself is silent."""
_T = TypeVar("_T")
_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

_HEADERS = {
    # Nothing is fetched from anywhere else, whatever a log or a reply holds; no other page frames this one.
    "Content-Security-Policy": "default-src 'self'; connect-src 'self'; img-src 'self' data:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


class Feed(Protocol):
    """Where packets come from: `ground.watch.tail.LogTail`, or `ground.console.link_feed.LinkFeed`."""

    @property
    def silence(self) -> float:
        """How long nothing has come, s."""

    def new(self) -> dict[str, PacketArray]:
        """Return the packets by name that came since the last call. Raises FlightError."""


@dataclass(slots=True)
class Console:
    """One flight on the page: its telemetry, the packets so far, its surroundings, a way to command it.

    `settled_ns` is the newest time of which all packets have come: what the page shows live.
    """

    name: str
    feed: Feed
    history: History
    surroundings: Surroundings
    commanding: Commanding
    utc_ns: int | None = None
    flight_heard: float = field(default_factory=time.monotonic)
    frames: FrameFolder = field(default_factory=lambda: FrameFolder(None))
    trouble: str = ""
    settled_ns: int = 0
    sockets: set[web.WebSocketResponse] = field(default_factory=set)

    def look(self) -> None:
        """Take in what has come since the last look; trouble is shown, and the next look tries again."""
        try:
            packets = self.feed.new()
        except FlightError as error:
            self.trouble = str(error)
            return
        self.trouble = ""
        newest_ns = self.history.span_ns[1]
        self.history.append(packets)
        # The packets of an instant may come in two looks: what the look before had is whole now.
        more = newest_ns > 0 and any(len(rows) for rows in packets.values())
        self.settled_ns = newest_ns if more else self.history.span_ns[1]
        if any(len(rows) for name, rows in packets.items() if name not in _OF_THE_LINK):
            self.flight_heard = time.monotonic()
        if len(packets["run"]):
            self.utc_ns = int(packets["run"]["utc_ns"][-1])


def application(console: Console, access: Access) -> web.Application:
    """Return the application; `console` must have looked once."""

    @web.middleware
    async def only_own_page(request: web.Request, handler: _Handler) -> web.StreamResponse:
        """Refuse a request of another page, and one without a session."""
        socket = request.headers.get("Upgrade", "").lower() == "websocket"
        if reason := foreign(request.headers, socket or request.method not in ("GET", "HEAD")):
            raise web.HTTPForbidden(text=reason)
        name = _cookie_name(request)
        if access.admits(request.cookies.get(name, "")):
            return await handler(request)
        token = request.query.get("token", "") if (request.method, request.path) == ("GET", "/") else ""
        session = access.exchange(token)
        if session is None:
            if request.path.startswith("/api/"):
                return web.json_response({"error": NO_ACCESS}, status=401)
            raise web.HTTPUnauthorized(text=NO_ACCESS)
        # No redirect: behind a link on another site, a browser would not send the cookie with it.
        response = await handler(request)
        response.set_cookie(name, session, httponly=True, samesite="Strict")
        return response

    app = web.Application(middlewares=[only_own_page, _errors_in_words])
    app.on_response_prepare.append(_add_headers)
    pages = _Pages(console)
    app.add_routes(
        [
            web.get("/", pages.index),
            web.get("/api/table", pages.table),
            web.get("/api/series", pages.series),
            web.get("/api/track", pages.track),
            web.get("/api/live", pages.live),
            web.get("/api/frame", pages.frame),
            web.get("/api/frame.png", pages.picture),
            web.post("/api/words", pages.words),
            web.post("/api/command", pages.command),
            web.static("/page", PAGE),
        ]
    )
    app.cleanup_ctx.append(lambda _: _looking(console))
    app.on_shutdown.append(lambda _: _goodbye(console))
    return app


async def _looking(console: Console) -> AsyncIterator[None]:
    async def look() -> None:
        while True:
            await asyncio.to_thread(console.look)
            await asyncio.sleep(_LOOK_S)

    task = asyncio.create_task(look())
    yield
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


async def _goodbye(console: Console) -> None:
    for line in list(console.sockets):
        await line.close(message=b"the console was ended")


async def _add_headers(_: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(_HEADERS)


def _cookie_name(request: web.Request) -> str:
    """Return the cookie's name: browsers share cookies between the ports of a host."""
    return "knightcube-console-" + (request.headers["Host"].partition(":")[2] or "80")


@web.middleware
async def _errors_in_words(request: web.Request, handler: _Handler) -> web.StreamResponse:
    try:
        return await handler(request)
    except (FlightError, TelemetryError) as error:
        status = 400 if isinstance(error, UsageError) else 502
        return web.json_response({"error": str(error)}, status=status)


class _Pages:
    """The answers to the page's requests."""

    def __init__(self, console: Console) -> None:
        self._console = console
        # One thread for pictures: each thread that makes one holds on to the memory of it.
        self._drawing = ThreadPoolExecutor(1)

    async def index(self, _: web.Request) -> web.StreamResponse:
        return web.FileResponse(PAGE / "index.html")

    async def table(self, _: web.Request) -> web.StreamResponse:
        """Answer with the telemetry and the commands as the tables define them."""
        console = self._console
        return web.json_response(
            {
                "packets": database()["packets"],
                "commands": command_table(console.commanding.layouts),
                "commanding": console.commanding.possible,
                "name": console.name,
                "camera": console.surroundings.camera,
                "coil_dipole": console.surroundings.coil_dipole,
                "orbit": console.surroundings.elements is not None,
                "utc_ns": console.utc_ns,
            }
        )

    async def series(self, request: web.Request) -> web.StreamResponse:
        """Answer with a field over time: ?packet=&field=&component=&from=&to= (s) &points=."""
        name, column = request.query.get("packet", ""), request.query.get("field", "")
        if name not in LAYOUTS or column not in (LAYOUTS[name].dtype.names or ()):
            raise UsageError(f"{name}.{column}: no such field")
        component = _whole(request, "component", 0)
        columns = LAYOUTS[name].dtype[column]
        if columns.kind == "S" or not 0 <= component < max(columns.shape or (1,)):
            raise UsageError(f"{name}.{column}[{component}]: no such number")
        span = (int(_real(request, "from") * 1e9), int(_real(request, "to") * 1e9))
        points = min(max(_whole(request, "points", 1000), 2), _MOST_POINTS)
        times, values = await asyncio.to_thread(
            self._console.history.series, name, column, component, span, points
        )
        finite = [value if abs(value) < float("inf") else None for value in values.tolist()]
        return web.json_response({"times": times.tolist(), "values": finite})

    async def track(self, request: web.Request) -> web.StreamResponse:
        """Answer with the ground track about a time: ?at= (s)."""
        utc = self._utc(_real(request, "at"))
        track = [] if utc is None else await asyncio.to_thread(self._console.surroundings.track, utc)
        return web.json_response({"track": track})

    async def frame(self, request: web.Request) -> web.StreamResponse:
        """Answer with what was found in a frame that was kept: ?sequence=; null where it was not."""
        sequence = _whole(request, "sequence", 0)
        facts = await self._drawn(self._console.frames.facts, sequence)
        return web.json_response(facts)

    async def picture(self, request: web.Request) -> web.StreamResponse:
        """Answer with the picture of a frame that was kept: ?sequence=."""
        found = await self._drawn(self._console.frames.picture, _whole(request, "sequence", 0))
        if found is None:
            raise web.HTTPNotFound(text="that frame was not kept")
        return web.Response(body=found, content_type="image/png")

    async def _drawn(self, make: Callable[[int], _T], sequence: int) -> _T:
        return await asyncio.get_running_loop().run_in_executor(self._drawing, make, sequence)

    async def words(self, request: web.Request) -> web.StreamResponse:
        """Answer with a command in words, before it is sent."""
        name, given = await _command_of(request)
        return web.json_response({"words": self._console.commanding.words(name, given)})

    async def command(self, request: web.Request) -> web.StreamResponse:
        """Send a command."""
        name, given = await _command_of(request)
        return web.json_response(await asyncio.to_thread(self._console.commanding.obey, name, given))

    async def live(self, request: web.Request) -> web.StreamResponse:
        """Push the state of the flight at the time that the reader's cursor shows."""
        line = web.WebSocketResponse(heartbeat=10.0, max_msg_size=4096)
        await line.prepare(request)
        self._console.sockets.add(line)
        cursor, instant = Cursor(), Instant(self._console.history)
        pushing = asyncio.create_task(self._push(line, cursor, instant))
        try:
            async for message in line:
                if message.type is WSMsgType.TEXT and cursor.obey(message.data, time.monotonic()):
                    instant.forget()
        finally:
            pushing.cancel()
            self._console.sockets.discard(line)
        return line

    async def _push(self, line: web.WebSocketResponse, cursor: Cursor, instant: Instant) -> None:
        with contextlib.suppress(ConnectionError):
            while not line.closed:
                await line.send_str(json.dumps(self._state(cursor, instant)))
                await asyncio.sleep(PUSH_S)

    def _state(self, cursor: Cursor, instant: Instant) -> dict[str, Any]:
        console = self._console
        span = console.history.span_ns[0], console.settled_ns
        at_ns = cursor.at_ns(span, time.monotonic())
        utc = self._utc(at_ns * 1e-9)
        return {
            "time": at_ns * 1e-9,
            "span": [span[0] * 1e-9, span[1] * 1e-9],
            "live": cursor.live,
            "speed": cursor.speed,
            "silence": console.feed.silence,
            "flight_silence": time.monotonic() - console.flight_heard,
            "trouble": console.trouble,
            "utc_ns": utc,
            "surroundings": None if utc is None else console.surroundings.at(utc),
            **instant.at(at_ns, LAYOUTS),
        }

    def _utc(self, seconds: float) -> int | None:
        start = self._console.utc_ns
        return None if start is None else start + int(seconds * 1e9)


async def _command_of(request: web.Request) -> tuple[str, dict[str, Any]]:
    try:
        body = await request.json()
        name, given = body["command"], body.get("values", {})
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError('a command is {"command": NAME, "values": {...}}') from error
    if not isinstance(name, str) or not isinstance(given, dict):
        raise UsageError('a command is {"command": NAME, "values": {...}}')
    return name, given


def _real(request: web.Request, name: str) -> float:
    text = request.query.get(name, "")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e9:  # s of mission time: 30 years; NaN compares false
        raise UsageError(f"{name} = {text!r}: give seconds of mission time")
    return value


def _whole(request: web.Request, name: str, default: int) -> int:
    text = request.query.get(name, str(default))
    if not text.isdigit():
        raise UsageError(f"{name} = {text!r}: give a whole number")
    return int(text)
