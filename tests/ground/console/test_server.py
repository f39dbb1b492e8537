"""Tests of the console's responses to its own page and to unauthorised clients."""

from __future__ import annotations

import asyncio
import errno
import math
import os
import shutil
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from aiohttp import WSServerHandshakeError
from aiohttp.test_utils import TestClient

from flight.link import commands
from flight.link.commands import COMMANDS, POINT, Command, crc_of
from flight.link.events import Mode
from flight.link.telemetry.definitions import PARAMETER_FIELDS
from flight.link.telemetry.packets import LAYOUTS, PacketArray
from ground.console import history, server
from ground.console.commanding import CommandForms, RunFiles
from ground.console.history import History
from ground.console.server import Access, Console
from ground.console.surroundings import UNKNOWN, FlightSurroundings
from ground.watch import LogTail
from ground.xtce import TELECOMMANDS
from knightcube.errors import UsageError
from knightcube.gnc.guidance.pointing_target import NUMBERS, Goal
from tests.ground.console.served import asked
from tests.ground.report.synthetic import Recipe, make_run

Answer = tuple[int, Any]
Ask = Callable[..., Awaitable[Answer]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run"), Recipe(duration=6.0, rate_hz=10.0, hold=3.0))


def get(folder: Path, path: str, headers: dict[str, str] | None = None) -> tuple[int, Any]:
    async def ask(client: TestClient[Any, Any]) -> tuple[int, Any]:
        async with client.get(path, headers=headers) as answer:
            return (
                answer.status,
                await answer.json() if "json" in answer.content_type else await answer.text(),
            )

    found: tuple[int, Any] = asked(folder, ask)
    return found


def test_the_page_and_all_that_it_names_are_served_and_stay_small(folder: Path) -> None:
    """All files that the page names are served. The files have at most 250 kB in total."""
    page = Path(__file__).parents[3] / "ground/console/page"
    names = [path.relative_to(page) for path in page.rglob("*") if path.is_file()]
    assert sum((page / name).stat().st_size for name in names) <= 250_000

    async def ask(client: TestClient[Any, Any]) -> None:
        async with client.get("/") as answer:
            assert answer.status == 200
            assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
        for name in names:
            async with client.get(f"/page/{name}") as answer:
                assert answer.status == 200, name

    asked(folder, ask)


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "10.0.0.1"},
        {"Host": "127.0.0.1.evil.example"},
        {"Host": "127.0.0.1:8040x"},
        {"Host": ""},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
    ],
)
def test_another_page_of_the_same_browser_gets_nothing(folder: Path, headers: dict[str, str]) -> None:
    """Requests for a rebound DNS name or from another origin are refused, even with a session cookie."""
    for path in ("/", "/api/table", "/api/live", "/page/main.js"):
        assert get(folder, path, headers)[0] == 403


def page_origin(client: TestClient[Any, Any]) -> str:
    """Return the origin of the console's page."""
    return str(client.make_url("/").origin())


@pytest.mark.parametrize("origin", [None, "http://evil.example", "http://localhost:1"])
def test_a_command_and_a_websocket_must_state_the_pages_own_origin(folder: Path, origin: str | None) -> None:
    headers = {} if origin is None else {"Origin": origin}

    async def ask(client: TestClient[Any, Any]) -> None:
        body = {"command": "safe", "values": {"reason": ""}}
        async with client.post("/api/command", json=body, headers=headers) as answer:
            assert answer.status == 403
        with pytest.raises(WSServerHandshakeError, match="403"):
            await client.ws_connect("/api/live", origin=origin)
        async with client.ws_connect("/api/live", origin=page_origin(client)) as line:
            assert (await line.receive_json())["live"]

    asked(folder, ask, send=lambda packet: pytest.fail("sent"))


def test_the_address_opens_the_page_for_one_browser_and_then_another_one_is_announced(folder: Path) -> None:
    announced: list[str] = []
    access = Access(announced.append)
    first = access.token

    async def ask(client: TestClient[Any, Any]) -> None:
        for path in ("/", "/?token=", "/?token=%C3%A9", f"/api/table?token={first}", "/page/main.js"):
            async with client.get(path) as answer:
                assert (answer.status, "open the newest address" in await answer.text()) == (401, True), path
        with pytest.raises(WSServerHandshakeError, match="401"):
            await client.ws_connect("/api/live", origin=page_origin(client))
        async with client.head(f"/?token={first}") as answer:
            assert answer.status == 401, "a preview of the address does not use the token up"
        async with client.get(f"/?token={first}") as answer:
            assert answer.status == 200
            cookie = answer.headers["Set-Cookie"]
            assert all(word in cookie for word in ("HttpOnly", "SameSite=Strict", str(client.port)))
            assert first not in cookie
        for path in ("/", f"/?token={first}", "/api/table"):
            async with client.get(path) as answer:
                assert answer.status == 200, "the same browser may use the address again"
        client.session.cookie_jar.clear()
        async with client.get(f"/?token={first}") as answer:
            assert answer.status == 401, "the token of the first browser"
        async with client.get(f"/?token={announced[0]}") as answer:
            assert answer.status == 200

    asked(folder, ask, access=access)
    assert len(announced) == 2
    assert len({first, *announced}) == 3


def test_every_answer_forbids_frames_bases_and_foreign_forms(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CommandForms, "text", lambda *_: 1 / 0)

    async def ask(client: TestClient[Any, Any]) -> list[tuple[int, str]]:
        found = []
        headers = {"Origin": page_origin(client)}
        for path in ("/", "/page/main.js", "/api/table", "/nowhere", "/api/series", "/page/nowhere.js"):
            async with client.get(path) as answer:
                found.append((answer.status, answer.headers["Content-Security-Policy"]))
        for path in ("/", "/api/words", "/api/command"):
            async with client.post(path, json={"command": "safe"}, headers=headers) as answer:
                found.append((answer.status, answer.headers["Content-Security-Policy"]))
        async with client.get("/", headers={"Origin": "null"}) as answer:
            found.append((answer.status, answer.headers["Content-Security-Policy"]))
        client.session.cookie_jar.clear()
        for path in ("/", "/api/table"):
            async with client.get(path) as answer:
                found.append((answer.status, answer.headers["Content-Security-Policy"]))
        return found

    answers = asked(folder, ask)
    assert {status for status, _ in answers} == {200, 400, 401, 403, 404, 405, 500}
    for _, policy in answers:
        rules = {rule.strip() for rule in policy.split(";")}
        assert rules >= {
            "frame-ancestors 'none'",
            "base-uri 'none'",
            "form-action 'self'",
            "default-src 'self'",
        }


def test_the_table_has_every_field_and_every_command(folder: Path) -> None:
    _, table = get(folder, "/api/table")
    assert {"control", "event", "navigation"} <= {packet["name"] for packet in table["packets"]}
    names = [packet.name for packet in COMMANDS if packet is not POINT]
    assert [command["name"] for command in table["commands"]] == names, "a testbed does not obey `point`"
    assert table["endings"]["camera-recovered"] == ["camera-lost", "camera-late"]
    assert (table["commanding"], table["orbit"]) == (False, False)


@pytest.mark.parametrize(
    ("query", "complaint"),
    [
        ("packet=none&field=q2&from=0&to=1", "none.q2: no such field"),
        ("packet=event&field=text&from=0&to=1", "no such component"),
        ("packet=imu&field=rate&component=3&from=0&to=1", "no such component"),
        ("packet=imu&field=rate&from=nan&to=1", "from = 'nan'"),
        ("packet=imu&field=rate&from=0&to=1&points=-3", "points = '-3'"),
    ],
)
def test_a_wrong_request_is_answered_with_a_reason(folder: Path, query: str, complaint: str) -> None:
    status, answer = get(folder, f"/api/series?{query}")
    assert status == 400
    assert complaint in answer["error"]


def test_a_table_that_would_be_too_long_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    query = "/api/series?packet=control&field=path_q2&from=0&to=1000"
    everything = get(folder, f"{query}&points=0")[1]
    monkeypatch.setattr(server, "_MOST_EXPORTED", len(everything["values"]) - 1)
    status, answer = get(folder, f"{query}&points=0")
    assert status == 400
    assert f"{len(everything['values'])} values: a table has at most" in answer["error"]
    assert get(folder, query)[0] == 200, "a plot shows minima and maxima"


def test_the_server_pushes_the_newest_state_and_then_a_requested_past_state(folder: Path) -> None:
    async def ask(client: TestClient[Any, Any]) -> tuple[Any, Any]:
        async with client.ws_connect("/api/live", origin=page_origin(client)) as line:
            newest = await line.receive_json()
            await line.send_json({"at": 2.0, "speed": 0.0})
            while not (past := await line.receive_json())["again"]:
                pass
            return newest, past

    newest, past = asked(folder, ask)
    assert (newest["live"], newest["again"], newest["time"]) == (True, True, newest["span"][1])
    assert (past["live"], past["time"], past["speed"]) == (False, 2.0, 0.0)
    assert past["newest"]["control"]["time_ns"] == 2 * 10**9


def test_a_history_that_cannot_be_read_is_reported_and_shown_when_it_can_be_read_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = True

    def pread(*given: Any) -> bytes:
        if broken:
            raise OSError(errno.EIO, "Input/output error")
        return os.pread(*given)

    monkeypatch.setattr(history, "os", SimpleNamespace(pread=pread, pwrite=os.pwrite))

    async def ask(client: TestClient[Any, Any]) -> tuple[Any, Any, Any]:
        nonlocal broken
        async with client.get("/api/series?packet=control&field=path_q2&from=0&to=1000") as answer:
            series = answer.status, await answer.json()
        async with client.ws_connect("/api/live", origin=page_origin(client)) as line:
            first = await line.receive_json()
            broken = False
            while not (second := await line.receive_json())["again"]:
                pass
            return series, first, second

    (status, error), first, second = asked(folder, ask)
    assert (status, error["error"]) == (502, "the disk failed: Input/output error")
    assert first["trouble"] == "the history of the console cannot be read: Input/output error"
    assert (first["newest"], first["again"], second["trouble"]) == ({}, False, "")
    assert second["newest"]["control"]["time_ns"] > 0


def test_a_log_that_grows_is_shown_within_a_second(folder: Path, tmp_path: Path) -> None:
    data = (folder / "flight-0001.ccsds").read_bytes()
    growing = tmp_path / "flight-0001.ccsds"
    growing.write_bytes(data[: len(data) // 2])

    async def ask(client: TestClient[Any, Any]) -> tuple[float, float]:
        async with client.ws_connect("/api/live", origin=page_origin(client)) as line:
            first = (await line.receive_json())["time"]
            growing.write_bytes(data)
            for _ in range(10):  # the server pushes updates ten times a second
                if (time := (await line.receive_json())["time"]) > first:
                    break
            return first, time

    first, time = asked(tmp_path, ask)
    assert time > first


def test_the_links_own_packets_do_not_hide_a_flight_that_is_silent(folder: Path) -> None:
    """Packets that the link itself sends once a second do not count as packets of the flight."""

    class Feed:
        silence, restarts, behind = 0.0, 0, False
        came: tuple[str, ...] = ("link", "verification")

        def new(self) -> dict[str, PacketArray]:
            return {name: np.zeros(int(name in self.came), layout.dtype) for name, layout in LAYOUTS.items()}

    with History() as history:
        feed = Feed()
        console = Console("link", feed, history, UNKNOWN, CommandForms(None))
        heard = console.flight_received
        console.read()
        assert console.flight_received == heard
        feed.came = ("link", "health")
        console.read()
        assert console.flight_received > heard


def test_a_frame_that_was_not_kept_is_null_and_has_no_picture(folder: Path) -> None:
    assert get(folder, "/api/frame?sequence=7") == (200, None)
    assert get(folder, "/api/frame.png?sequence=7") == (404, "this frame was not kept")
    assert get(folder, "/api/frame?sequence=x")[0] == 400


def test_the_live_state_is_shown_only_when_it_is_complete(folder: Path) -> None:
    """The live state is shown only when all packets of an instant have arrived.

    Packets of one instant may arrive in two updates. Until the second update, the state of the previous
    instant is shown.
    """

    class Feed:
        silence, restarts, behind = 0.0, 0, False
        came: tuple[tuple[str, int], ...] = ()

        def new(self) -> dict[str, PacketArray]:
            arrays: dict[str, PacketArray] = {n: np.zeros(0, layout.dtype) for n, layout in LAYOUTS.items()}
            for name, time_ns in self.came:
                arrays[name] = np.zeros(1, LAYOUTS[name].dtype)
                arrays[name]["time_ns"] = time_ns
            return arrays

    with History() as history:
        feed, settled = Feed(), []
        console = Console("run", feed, history, UNKNOWN, CommandForms(None))
        for came in ((("control", 100),), (("health", 100), ("control", 125)), (("health", 125),), ()):
            feed.came = came
            console.read()
            settled.append(console.settled_ns)
    assert settled == [100, 100, 125, 125]


def commanded(folder: Path, name: str, values: Any, send: Any) -> tuple[int, Any]:
    async def ask(client: TestClient[Any, Any]) -> tuple[int, Any]:
        body, headers = {"command": name, "values": values}, {"Origin": page_origin(client)}
        async with client.post("/api/command", json=body, headers=headers) as answer:
            return answer.status, await answer.json()

    found: tuple[int, Any] = asked(folder, ask, send)
    return found


def test_each_command_of_the_table_is_packed_from_a_form_as_the_codec_reads_it(folder: Path) -> None:
    table = [field.valid[0] for field in PARAMETER_FIELDS if field.valid]
    named = {field.name: value for field, value in zip(PARAMETER_FIELDS, table, strict=True)}
    forms: dict[str, dict[str, Any]] = {
        "ping": {"number": "7"},
        "safe": {"reason": "bored"},
        "mode": {"mode": int(Mode.HOLD)},
        "slew": {"q2": "0.25"},
        "clear": {"event": "coil-broken"},
        "load-parameters": {"replaced": 7, "crc": "", **named},
        "dump-parameters": {},
    }
    assert set(forms) == {packet.name for packet in COMMANDS} - {POINT.name}
    sent: list[Command] = []

    def send(packet: bytes) -> dict[str, Any]:
        sent.append(commands.unpack(packet))
        return {"obeyed": 1, "text": "done"}

    for name, values in forms.items():
        status, answer = commanded(folder, name, values, send)
        assert (status, answer["obeyed"], answer["text"]) == (200, 1, "done")
    words = [command.text for command in sent]
    assert words[:5] == ["ping 7", "mode safe: bored", "mode hold", "slew to q2 +0.2500", "clear coil-broken"]
    assert words[5:] == [f"load-parameters {crc_of(table):08x} replacing 00000007", "dump-parameters"]


@pytest.mark.parametrize(
    ("name", "values", "complaint"),
    [
        ("none", {}, "none: no such command"),
        ("slew", {"q2": "0.9"}, "q2 = 0.9 must lie within"),
        ("slew", {"q2": "much"}, "'much' is not a number"),
        ("slew", {"q2": True}, "True is not a number"),
        ("mode", {"mode": 1.9}, "1.9 is not a whole number"),
        ("ping", {}, "number is missing"),
        ("slew", {"q2": 0.1, "fast": 1}, "no such value: fast"),
        ("slew", "0.1", "a command has"),
        ("point", {"goal": 0}, "point: no such command"),
        ("mode", {"mode": int(Mode.SUN)}, "mode sun: this body has no such mode"),
        ("clear", {"event": "coil-brokn"}, "'coil-brokn' is not the name of an event"),
    ],
)
def test_values_that_do_not_form_a_command_are_never_sent(
    folder: Path, name: str, values: Any, complaint: str
) -> None:
    status, answer = commanded(folder, name, values, lambda packet: pytest.fail("sent"))
    assert status == 400
    assert complaint in answer["error"]


def test_the_confirmation_of_a_command_is_in_words() -> None:
    forms = CommandForms(None, TELECOMMANDS)
    assert forms.text("safe", {"reason": "end of pass"}) == "mode safe: end of pass"
    assert forms.text("mode", {"mode": int(Mode.DETUMBLE)}) == "mode detumble"
    scheduled = {"at": "2099-01-01T00:00:00", "words": "safe night"}
    assert forms.text("schedule", scheduled) == "at 2099-01-01T00:00:00: mode safe: night"


@pytest.mark.parametrize(
    ("numbers", "complaint"),
    [([0.0, 0.0, 0.0, 1.0, 0.5], "numbers has 5 values: give at most 4"), ("00000001", "must be finite")],
)
def test_an_inertial_goal_needs_four_numbers(numbers: Any, complaint: str) -> None:
    given = {"goal": int(Goal.INERTIAL), "numbers": numbers}
    with pytest.raises(UsageError, match=complaint):
        CommandForms(None).text("point", given)


def test_a_satellite_points_by_named_numbers_and_refuses_commands_of_a_testbed() -> None:
    forms = CommandForms(None, TELECOMMANDS)
    forms.body = "orbit"
    table = {command["name"]: command for command in forms.table()}
    assert "slew" not in table
    inputs = {(one["name"], *one.get("only", ["", []])[1]): one for one in table["point"]["inputs"]}
    assert inputs["latitude", Goal.GROUND]["valid"] == [-0.5 * math.pi, 0.5 * math.pi]
    numbered = [key[1] for key, one in inputs.items() if "index" in one]
    counts = {goal: numbered.count(goal) for goal in Goal}
    assert counts == {goal: max(NUMBERS.get(goal, (0,))) for goal in Goal}
    assert (
        forms.text("point", {"goal": 4, "numbers": [0.5, 0.25]})
        == "point ground latitude 28.6479, longitude 14.3239 deg, roll free"
    )
    refused: list[tuple[str, dict[str, Any], str]] = [
        ("mode", {"mode": int(Mode.HOLD)}, "no such mode"),
        ("schedule", {"at": "2099-01-01T00:00:00", "words": "slew 0.2"}, "does not accept slew"),
        ("schedule", {"at": "2099-01-01T00:00:00", "words": "point groud"}, "groud"),
        ("schedule", {"at": "2001-01-01T00:00:00", "words": "point sun"}, "has passed"),
        ("schedule", {"at": "soon", "words": "point sun"}, "not a UTC"),
        ("use-file", {"name": "received/elements/tle.txt", "sum": "ab" * 31}, "64 hexadecimal digits"),
    ]
    for name, values, complaint in refused:
        with pytest.raises(UsageError, match=complaint):
            forms.text(name, values)
    assert (
        forms.text("use-file", {"name": "received/elements/a", "sum": "ab" * 32}) == "use received/elements/a"
    )


def test_files_are_listed_downloaded_and_uploaded_whole(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = RunFiles(folder).listing()["files"][0]["name"]
    receipt = {"name": "elements/tle.txt", "bytes": 3}
    put = Mock(return_value=receipt)
    monkeypatch.setattr(RunFiles, "put", put)

    async def ask(client: TestClient[Any, Any]) -> Answer:
        query, headers = {"kind": "elements", "name": "tle.txt"}, {"Origin": page_origin(client)}
        async with client.post("/api/file", params=query, data=b"1 2", headers=headers) as answer:
            assert await answer.json() == receipt
        async with client.get("/api/file", params={"name": name}) as answer:
            assert await answer.read() == (folder / name).read_bytes()
        async with client.get("/api/files") as answer:
            return answer.status, await answer.json()

    assert asked(folder, ask) == (200, RunFiles(folder).listing())
    put.assert_called_once_with("elements", "tle.txt", b"1 2")


def test_doubts_about_a_flight_are_shown_on_the_page(folder: Path) -> None:
    doubts = ["", "the flight process was killed by signal 9"]
    with History() as history:
        console = Console("run", LogTail(folder), history, UNKNOWN, CommandForms(None))
        console.doubts = tuple(partial(str, text) for text in doubts)
        console.read()
    assert console.trouble == doubts[1]


@pytest.mark.parametrize("data", [b"FOO / HTTP/1.1\r\n\r\n", b"GET /" + b"a" * 9000 + b" HTTP/1.1\r\n\r\n"])
def test_bytes_that_are_not_http_print_no_traceback(
    folder: Path, data: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    async def ask(client: TestClient[Any, Any]) -> bytes:
        reader, writer = await asyncio.open_connection("127.0.0.1", client.port)
        writer.write(data)
        answer = await reader.readline()
        writer.close()
        return answer

    assert b" 400 " in asked(folder, ask)
    assert not [record for record in caplog.records if record.exc_info]


def test_wrong_days_of_a_prediction_are_named(folder: Path) -> None:
    status, answer = get(folder, "/api/passes?at=0&days=nan&station=Berlin,52.5,13.4")
    assert (status, answer["error"]) == (400, "days = 'nan': give up to a week, in days")


def test_without_a_way_to_the_flight_nothing_is_sent(folder: Path) -> None:
    status, answer = commanded(folder, "safe", {"reason": ""}, None)
    assert (status, "--to" in answer["error"]) == (400, True)


def test_a_satellites_place_is_known_from_its_elements_and_without_a_configuration_nothing_is(
    tmp_path: Path,
) -> None:
    """The position of a satellite follows from its elements.

    Without a configuration, the position is unknown. At an equinox at noon UTC, the Sun is above the equator
    at about 2 deg east.
    """
    shutil.copy(Path(__file__).parents[3] / "config/orbit.yaml", tmp_path / "config.yaml")
    noon = int(datetime(2026, 3, 20, 12, tzinfo=UTC).timestamp() * 1e9)
    place = FlightSurroundings.of(tmp_path / "config.yaml").at(noon)
    assert place is not None
    assert place["altitude_km"] == pytest.approx(500.0, abs=25.0)
    assert (place["sun_latitude"], place["sun_longitude"]) == (
        pytest.approx(0.0, abs=0.3),
        pytest.approx(1.9, abs=0.5),
    )
    # The nadir direction is normal to the velocity, and the ground track passes below the satellite.
    track = np.array(FlightSurroundings.of(tmp_path / "config.yaml").track(noon))
    assert np.hypot(*(track - [place["latitude"], place["longitude"]]).T).min() < 0.5
    assert np.dot(place["nadir"], place["velocity"]) == pytest.approx(0.0, abs=0.01)
    coil = FlightSurroundings.of(tmp_path / "config.yaml").coil_dipole
    assert coil == pytest.approx(0.648 * 0.148), "A m^2 of a coil at its limit"
    unknown = FlightSurroundings.of(tmp_path / "nowhere")
    assert (unknown.at(noon), unknown.track(noon)) == (None, [])
