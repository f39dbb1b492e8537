"""Web server of the console, with telemetry of one flight and commands from forms, on loopback only.

Only a browser that opened an address with a token may use the console. Each token is valid for one browser:
the first request with a token receives a cookie, and the token is replaced. An address with a used token,
which another user of the machine may find in the list of processes, is therefore useless. The headers Host
and Origin are also checked, because DNS rebinding and pages of another origin could reach the console through
the operator's own browser.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import logging
import re
import secrets
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol, TypeVar

from aiohttp import WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from flight.link.commands import Point, words_of
from flight.link.process.directives import KINDS
from flight.link.telemetry.definitions import CONTROL, LINK, NAVIGATION, SPIN, TRANSFER, VERIFICATION
from flight.link.telemetry.packets import LAYOUTS, PacketArray, TelemetryError
from ground.console.commanding import CommandForms, Files
from ground.console.history import EMPTY_STATE, MAX_TIME, History, PageCursor, PageState
from ground.console.surroundings import FlightSurroundings, FrameFolder
from ground.documentation import Body, add_components, database, endings
from ground.watch import PacketSource
from knightcube.errors import KnightCubeError, UsageError, reason_of

PAGE = Path(__file__).parent / "page"
PUSH_S = 0.1
NO_ACCESS = "open the newest address that `knightcube console` printed: the page needs the token in it"
_READ_S = 0.03  # time (s) between two reads of new packets
_MAX_POINTS = 4000
_MOST_EXPORTED = 1_000_000
_MAX_DIGITS = 18
_MAX_PATH = 200
_RANDOM_BYTES = 32
_OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:[0-9]{1,5})?")
_OF_THE_LINK = frozenset({LINK.name, VERIFICATION.name, TRANSFER.name})
"""Packet types that the link process sends, even if the flight process is silent."""
_BODY_OF: dict[str, Body] = {CONTROL.name: "testbed", NAVIGATION.name: "orbit", SPIN.name: "orbit"}
"""Kind of body (testbed or orbit) by the name of a packet type that only this kind of body sends."""
_MOST_UPLOAD = 1 << 24  # largest size (bytes) of a file that the page uploads to the satellite
_MOST_STATIONS = 20
_MOST_DAYS = 7.0
_T = TypeVar("_T")
_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

_HEADERS = {
    # Content security policy, which lets the browser load only from this server and forbids frames.
    "Content-Security-Policy": "default-src 'self'; connect-src 'self'; img-src 'self' data:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


class ConsoleFeed(PacketSource, Protocol):
    """Source of the packets that the console shows."""

    @property
    def restarts(self) -> int:
        """Number of restarts of the flight, at each of which the mission time began again at zero."""


@dataclass(slots=True)
class Console:
    """One flight on the page.

    Attributes:
        name: name of the flight on the page.
        feed: source of the flight's packets.
        history: packets received so far.
        surroundings: orbit, body and devices in the configuration of the flight.
        forms: sender of the commands that the operator enters in forms of the page.
        utc_ns: UTC at mission time zero, ns, or None while unknown.
        flight_received: monotonic time of the last packet of the flight itself, s.
        frames: camera frames that the flight has kept.
        trouble: reason why the last read failed, or the texts of `doubts`, or an empty text.
        doubts: functions that describe damage of the log or the end of the flight process, or return "".
        files: files of the satellite, or None if the files are not accessible.
        stations: ground stations in the panel of passes until the operator enters other stations.
        settled_ns: newest time (ns) up to which all packets have been received, which the live page shows.
        restarts: number of restarts of the flight; the history contains the packets since the last restart.
        unstored: packets that were read but could not be stored in the history yet.
        sockets: open WebSockets.
    """

    name: str
    feed: ConsoleFeed
    history: History
    surroundings: FlightSurroundings
    forms: CommandForms
    utc_ns: int | None = None
    flight_received: float = field(default_factory=time.monotonic)
    frames: FrameFolder = field(default_factory=lambda: FrameFolder(None))
    files: Files | None = None
    stations: tuple[str, ...] = ()
    trouble: str = ""
    doubts: tuple[Callable[[], str], ...] = ()
    settled_ns: int = 0
    restarts: int = 0
    unstored: dict[str, PacketArray] = field(default_factory=dict)
    sockets: set[web.WebSocketResponse] = field(default_factory=set)

    @property
    def body(self) -> Body | None:
        """Kind of body from the configuration, or else from the packets; None while unknown."""
        if self.surroundings.body is not None:
            return self.surroundings.body
        for name, body in _BODY_OF.items():
            if self.history.count(name, self.history.span_ns[1]):
                return body
        return None

    def read(self) -> None:
        """Read the new packets. A failure is stored in `trouble`, and the next read tries again."""
        try:
            self.unstored = self.unstored or self.feed.new()
            if self.feed.restarts != self.restarts:
                self.restarts, self.utc_ns = self.feed.restarts, None
                self.history.clear()
            newest_ns = self.history.span_ns[1]
            self.history.append(self.unstored)
        except KnightCubeError as error:
            self.trouble = str(error)
            return
        except OSError as error:
            self.trouble = f"the console cannot store new packets: {reason_of(error)}: free disk space"
            return
        packets, self.unstored = self.unstored, {}
        doubts = [text for doubt in self.doubts if (text := doubt())]
        if self.restarts:
            doubts.append(
                f"restarts of the flight: {self.restarts}; the page shows the packets since the last restart"
            )
        self.trouble = "; ".join(doubts)
        # Packets of the same time may arrive in two reads, so the page omits the times of the newest read.
        more = newest_ns > 0 and any(len(rows) for rows in packets.values())
        self.settled_ns = newest_ns if more else self.history.span_ns[1]
        if any(len(rows) for name, rows in packets.items() if name not in _OF_THE_LINK):
            self.flight_received = time.monotonic()
        if len(packets["run"]):
            self.utc_ns = int(packets["run"]["utc_ns"][-1])
        self.forms.body = self.body


class Access:
    """Access control: token for the next browser, and cookies of the sessions."""

    def __init__(self, announce: Callable[[str], object]) -> None:
        """Make a token. The function `announce` receives each token that replaces a used token."""
        self._announce = announce
        self._sessions: list[str] = []
        self.token = secrets.token_urlsafe(_RANDOM_BYTES)

    def open_session(self, token: str) -> str | None:
        """Return the cookie of a new session if `token` is the current token, else None."""
        if not _equal(token, self.token):
            return None
        self._sessions.append(secrets.token_urlsafe(_RANDOM_BYTES))
        self.token = secrets.token_urlsafe(_RANDOM_BYTES)
        self._announce(self.token)
        return self._sessions[-1]

    def admits(self, cookie: str) -> bool:
        """Return whether a cookie belongs to a session."""
        return any([_equal(cookie, session) for session in self._sessions])


def _equal(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode(errors="replace"), other.encode())


def refusal(headers: Mapping[str, str], origin_required: bool) -> str:
    """Return the reason why a request is not from the console's own page, or an empty text.

    Browsers state the origin of each POST and each WebSocket, so these requests must have an Origin
    (`origin_required`).
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if not _OWN_HOST.fullmatch(host):
        return "this console accepts requests on loopback only"
    if origin is None:
        if not origin_required:
            return ""
        return "this console accepts requests of its own page only: the request states no Origin"
    return "" if origin == f"http://{host}" else "this console accepts requests of its own page only"


def application(console: Console, access: Access) -> web.Application:
    """Return the web application of a console, which must have read packets at least once."""

    @web.middleware
    async def only_own_page(request: web.Request, handler: _Handler) -> web.StreamResponse:
        """Refuse requests from other pages and requests without a session."""
        socket = request.headers.get("Upgrade", "").lower() == "websocket"
        if reason := refusal(request.headers, socket or request.method not in ("GET", "HEAD")):
            raise web.HTTPForbidden(text=reason)
        # Browsers share cookies between the ports of a host.
        name = "knightcube-console-" + (request.headers["Host"].partition(":")[2] or "80")
        if access.admits(request.cookies.get(name, "")):
            return await handler(request)
        token = request.query.get("token", "") if (request.method, request.path) == ("GET", "/") else ""
        session = access.open_session(token)
        if session is None:
            if request.path.startswith("/api/"):
                return web.json_response({"error": NO_ACCESS}, status=401)
            raise web.HTTPUnauthorized(text=NO_ACCESS)
        # The page is sent without a redirect, because some browsers send no cookie after a redirect.
        response = await handler(request)
        response.set_cookie(name, session, httponly=True, samesite="Strict")
        return response

    logging.getLogger("aiohttp.server").addFilter(_is_not_a_malformed_request)
    app = web.Application(middlewares=[only_own_page, _errors_as_json], client_max_size=_MOST_UPLOAD)
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
            web.get("/api/passes", pages.passes),
            web.get("/api/files", pages.files),
            web.get("/api/file", pages.file),
            web.post("/api/file", pages.put),
            web.post("/api/words", pages.words),
            web.post("/api/command", pages.command),
            web.static("/page", PAGE),
        ]
    )
    app.cleanup_ctx.append(lambda _: _reading(console))
    app.on_shutdown.append(lambda _: _close_sockets(console))
    return app


def _is_not_a_malformed_request(record: logging.LogRecord) -> bool:
    """Return False for a logged error about received bytes that are not HTTP."""
    return record.exc_info is None or not isinstance(record.exc_info[1], HttpProcessingError)


async def _reading(console: Console) -> AsyncIterator[None]:
    async def read() -> None:
        while True:
            await asyncio.to_thread(console.read)
            await asyncio.sleep(_READ_S)

    task = asyncio.create_task(read())
    yield
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


async def _close_sockets(console: Console) -> None:
    for line in list(console.sockets):
        await line.close(message=b"the console has ended")


async def _add_headers(_: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(_HEADERS)


@web.middleware
async def _errors_as_json(request: web.Request, handler: _Handler) -> web.StreamResponse:
    if len(request.path) > _MAX_PATH:
        raise web.HTTPNotFound(text="there is no such page")
    try:
        return await handler(request)
    except (KnightCubeError, TelemetryError) as error:
        status = 400 if isinstance(error, UsageError) else 502
        return web.json_response({"error": str(error)}, status=status)
    except ConnectionError:  # the browser has closed the connection
        raise
    except OSError as error:
        return web.json_response({"error": f"the disk failed: {reason_of(error)}"}, status=502)


class _Pages:
    """Handlers that answer the requests of the page."""

    def __init__(self, console: Console) -> None:
        self._console = console
        # Pictures are drawn in one thread, because every thread would keep the memory of its largest picture.
        self._drawing = ThreadPoolExecutor(1)

    async def index(self, _: web.Request) -> web.StreamResponse:
        return web.FileResponse(PAGE / "index.html")

    async def table(self, _: web.Request) -> web.StreamResponse:
        """Answer with the definitions of telemetry and commands."""
        console = self._console
        return web.json_response(
            {
                "packets": add_components(database()["packets"]),
                "commands": console.forms.table(),
                "endings": endings(),
                "body": console.body,
                "stations": list(console.stations),
                "files": console.files is not None,
                "puts": [] if console.files is None or not console.files.puts else list(KINDS),
                "resistance": list(console.surroundings.resistance),
                "currents": console.surroundings.currents,
                "commanding": console.forms.possible,
                "name": console.name,
                "camera": console.surroundings.camera,
                "coil_dipole": console.surroundings.coil_dipole,
                "orbit": console.surroundings.elements is not None,
                "utc_ns": console.utc_ns,
            }
        )

    async def series(self, request: web.Request) -> web.StreamResponse:
        """Answer the query ?packet=&field=&component=&from=&to= (s) &points= with a field's values over time.

        With points=0 the answer contains every value in the time span; more than a million are refused.
        """
        name, column = request.query.get("packet", ""), request.query.get("field", "")
        if name not in LAYOUTS or column not in (LAYOUTS[name].dtype.names or ()):
            raise UsageError(f"{name}.{column}: no such field")
        component = _whole(request, "component", 0)
        columns = LAYOUTS[name].dtype[column]
        if columns.kind == "S" or not 0 <= component < max(columns.shape or (1,)):
            raise UsageError(f"{name}.{column}[{component}]: no such component")
        span = (int(_real(request, "from") * 1e9), int(_real(request, "to") * 1e9))
        points = _whole(request, "points", 1000)
        history = self._console.history
        count = history.count(name, span[1]) - history.count(name, span[0] - 1)
        if not points and count > _MOST_EXPORTED:
            raise UsageError(
                f"{count} values: a table has at most {_MOST_EXPORTED}: zoom to a shorter span, or write the "
                "whole run with `knightcube export RUN`"
            )
        points = min(max(points, 2), _MAX_POINTS) if points else _MOST_EXPORTED
        times, values = await asyncio.to_thread(history.series, name, column, component, span, points)
        finite = [value if abs(value) < float("inf") else None for value in values.tolist()]
        return web.json_response({"times": times.tolist(), "values": finite})

    async def track(self, request: web.Request) -> web.StreamResponse:
        """Answer the query ?at= (s) with the ground track around this time."""
        utc = self._utc(_real(request, "at"))
        track = [] if utc is None else await asyncio.to_thread(self._console.surroundings.track, utc)
        return web.json_response({"track": track})

    async def frame(self, request: web.Request) -> web.StreamResponse:
        """Answer the query ?sequence= with the results of this frame, or null if the frame was not kept."""
        found = await self._drawn(self._console.frames.facts, _whole(request, "sequence", 0))
        return web.json_response(found)

    async def picture(self, request: web.Request) -> web.StreamResponse:
        """Answer the query ?sequence= with the image of the kept frame that has this number."""
        found = await self._drawn(self._console.frames.picture, _whole(request, "sequence", 0))
        if found is None:
            raise web.HTTPNotFound(text="this frame was not kept")
        return web.Response(body=found, content_type="image/png")

    async def _drawn(self, make: Callable[[int], _T], sequence: int) -> _T:
        return await asyncio.get_running_loop().run_in_executor(self._drawing, make, sequence)

    async def passes(self, request: web.Request) -> web.StreamResponse:
        """Answer the query ?at= (s) &days= &station= with passes and their scheduled commands."""
        stations = request.query.getall("station", [])
        if len(stations) > _MOST_STATIONS:
            raise UsageError(f"{len(stations)} stations: give at most {_MOST_STATIONS}")
        at, days = self._utc(_real(request, "at")), _real(request, "days", "up to a week, in days")
        lines = self._console.surroundings.lines
        if lines is None or at is None:
            raise UsageError(
                "the orbit is not known: passes need two-line elements and the time of the flight"
            )
        if not 0.0 < days <= _MOST_DAYS:
            raise UsageError(f"days = {days:g}: give up to {_MOST_DAYS:g} days")
        begin = datetime.fromtimestamp(at * 1e-9, UTC)
        return web.json_response(await asyncio.to_thread(_predicted, lines, begin, days, stations))

    async def files(self, _: web.Request) -> web.StreamResponse:
        """Answer with the list of the satellite's files."""
        return web.json_response(await asyncio.to_thread(self._files.listing))

    async def file(self, request: web.Request) -> web.StreamResponse:
        """Answer the query ?name= with the content of a file, after it was received from the satellite."""
        path = await asyncio.to_thread(self._files.get, request.query.get("name", ""))
        name = re.sub(r"[^A-Za-z0-9_.+-]", "_", path.name)
        return web.FileResponse(path, headers={"Content-Disposition": f'attachment; filename="{name}"'})

    async def put(self, request: web.Request) -> web.StreamResponse:
        """Upload the body of the request to the satellite, as a file with the queried kind and name."""
        kind, name = request.query.get("kind", ""), request.query.get("name", "")
        data = await request.read()
        return web.json_response(await asyncio.to_thread(self._files.put, kind, name, data))

    @property
    def _files(self) -> Files:
        if self._console.files is None:
            raise UsageError("the files of this flight are not known")
        return self._console.files

    async def words(self, request: web.Request) -> web.StreamResponse:
        """Answer with the text of a command for its confirmation, or with the reason why it is refused."""
        name, given = await _command_of(request)
        try:
            return web.json_response({"words": self._console.forms.text(name, given)})
        except UsageError as error:  # expected while the operator fills in the form
            return web.json_response({"error": str(error)})

    async def command(self, request: web.Request) -> web.StreamResponse:
        """Send a command to the flight, and answer with the result of the command."""
        name, given = await _command_of(request)
        return web.json_response(await asyncio.to_thread(self._console.forms.obey, name, given))

    async def live(self, request: web.Request) -> web.StreamResponse:
        """Send the flight's state at the chosen time over a WebSocket, repeatedly."""
        line = web.WebSocketResponse(heartbeat=10.0, max_msg_size=4096)
        await line.prepare(request)
        self._console.sockets.add(line)
        cursor, state = PageCursor(), PageState(self._console.history)
        pushing = asyncio.create_task(self._push(line, cursor, state))
        try:
            async for message in line:
                if message.type is WSMsgType.TEXT and cursor.obey(message.data, time.monotonic()):
                    state.reset()
        finally:
            pushing.cancel()
            self._console.sockets.discard(line)
        return line

    async def _push(self, line: web.WebSocketResponse, cursor: PageCursor, state: PageState) -> None:
        with contextlib.suppress(ConnectionError):
            while not line.closed:
                await line.send_str(json.dumps(self._message(cursor, state)))
                await asyncio.sleep(PUSH_S)

    def _message(self, cursor: PageCursor, state: PageState) -> dict[str, Any]:
        console = self._console
        span = console.history.span_ns[0], console.settled_ns
        at_ns = cursor.at_ns(span, time.monotonic())
        utc = self._utc(at_ns * 1e-9)
        trouble, shown = console.trouble, EMPTY_STATE
        try:
            shown = state.at(at_ns, LAYOUTS)
        except OSError as error:
            state.reset()  # the next readable state is sent as a whole
            trouble = f"the history of the console cannot be read: {reason_of(error)}"
        return {
            "time": at_ns * 1e-9,
            "span": [span[0] * 1e-9, span[1] * 1e-9],
            "live": cursor.live,
            "speed": cursor.speed,
            "silence": console.feed.silence,
            "flight_silence": time.monotonic() - console.flight_received,
            "trouble": trouble,
            "utc_ns": utc,
            "body": console.forms.body,
            "surroundings": None if utc is None else console.surroundings.at(utc),
            **shown,
        }

    def _utc(self, seconds: float) -> int | None:
        start = self._console.utc_ns
        return None if start is None else start + int(seconds * 1e9)


def _predicted(lines: tuple[str, str], begin: datetime, days: float, stations: list[str]) -> dict[str, Any]:
    """Return the passes over stations, each with its scheduled commands: UTC, command words, description."""
    from ground.passes import SENDING, OrbitPrediction, facts_of, scheduled_targets, station_of  # noqa: PLC0415 - large

    prediction = OrbitPrediction(lines, begin, days)
    found = []
    passes = prediction.passes([station_of(text) for text in stations])
    for one, targets in zip(passes, scheduled_targets(passes, earliest=begin + SENDING), strict=True):
        schedule = []
        for utc, target in targets:
            at, words = f"{utc:%Y-%m-%dT%H:%M:%S}", words_of(Point(target))
            schedule.append({"at": at, "words": words, "text": f"point {target.text}"})
        found.append({**facts_of(one), "mask_deg": one.station.mask_deg, "schedule": schedule})
    return {"passes": found, "timing_error_s": prediction.timing_error_s}


async def _command_of(request: web.Request) -> tuple[str, dict[str, Any]]:
    try:
        body = await request.json()
        name, given = body["command"], body.get("values", {})
        if not isinstance(name, str) or not isinstance(given, dict):
            raise TypeError
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise UsageError('a command has the form {"command": NAME, "values": {...}}') from error
    return name, given


def _real(request: web.Request, name: str, wanted: str = "the mission time in seconds") -> float:
    text = request.query.get(name, "")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < MAX_TIME:  # also for NaN
        raise UsageError(f"{name} = {text!r:.40}: give {wanted}")
    return value


def _whole(request: web.Request, name: str, default: int) -> int:
    text = request.query.get(name, str(default))
    if not (text.isascii() and text.isdigit() and len(text) <= _MAX_DIGITS):
        raise UsageError(f"{name} = {text!r:.40}: give a whole number of at most {_MAX_DIGITS} digits")
    return int(text)
