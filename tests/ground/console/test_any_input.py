"""Tests that any request gets an answer without status 500, and that only complete commands are sent."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aiohttp.test_utils import TestClient

from flight.link import commands
from flight.link.commands import COMMANDS
from ground.console.history import PageCursor
from tests.ground.console.served import asked
from tests.ground.report.synthetic import Recipe, make_run

SEED = 35
HUGE = "9" * 400
NESTED = "[" * 100_000 + "]" * 100_000
ODD = [
    *(
        "Infinity",
        "-Infinity",
        "NaN",
        "1e400",
        "-1e308",
        HUGE,
        f"-{HUGE}",
        "9" * 5000,
        f"{2**63}",
        f"{2**64}",
    ),
    *(
        "null",
        "true",
        "[]",
        "{}",
        "[[]]",
        "[null, null, null, null, null]",
        '{"a": {"b": []}}',
        '[1, "x", {}]',
    ),
    *(
        '""',
        '"x"',
        '"\\u0000"',
        '"\\ud800"',
        '"\\u001b[2J"',
        '"1e400"',
        '"nan"',
        '"²"',
        '"٣"',
        '"1_0"',
        '" 7 "',
    ),
    *(f'"{HUGE}"', f'"{"x" * 5000}"', '"' + "9" * 5000 + '"', "[" * 500 + "]" * 500, "0.1", "-0", "7"),
]
"""JSON values that no form of the page sends."""
NUMBERS = [
    *(
        "",
        "nan",
        "inf",
        "-inf",
        "1e400",
        "-1e309",
        "1e9",
        "-1e8",
        "999999999",
        HUGE,
        "9" * 5000,
        "²",
        "٣",
        "-3",
    ),
    *(
        "1_0",
        "0x10",
        "7 ",
        "%00",
        "%ff",
        "1e-400",
        "2147483648",
        f"{2**63}",
        f"{2**64}",
        "x" * 5000,
        "[]",
        "+1",
    ),
]
"""Texts for numbers in the query of a URL."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run"), Recipe(duration=6.0, rate_hz=10.0, hold=3.0))


def bodies(draw: np.random.Generator) -> Iterator[tuple[bytes, str]]:
    """Yield command bodies and their content types."""
    for packet in COMMANDS:
        names = [field.name for field in packet.fields]
        for odd in ODD:
            values = ", ".join(f"{json.dumps(name)}: {odd}" for name in names)
            yield f'{{"command": "{packet.name}", "values": {{{values}}}}}'.encode(), "application/json"
        for _ in range(25):
            values = ", ".join(f"{json.dumps(name)}: {ODD[draw.integers(len(ODD))]}" for name in names)
            yield f'{{"command": "{packet.name}", "values": {{{values}}}}}'.encode(), "application/json"
    for odd in ODD:
        yield f'{{"command": {odd}, "values": {{}}}}'.encode(), "application/json"
        yield f'{{"command": "ping", "values": {odd}}}'.encode(), "application/json"
        yield odd.encode(), "application/json"
    yield NESTED.encode(), "application/json"
    yield f'{{"command": "ping", "values": {{"number": {NESTED}}}}}'.encode(), "application/json"
    ping = b'{"command": "ping", "values": {"number": 1}}'
    for kind in (
        "application/json; charset=nosuch",
        "text/plain; charset=utf-16",
        "x",
        "a/b; charset=\xff",
        "",
    ):
        yield ping, kind
    yield b"\xff\xfe\x00", "application/json"
    yield b"", "application/json"
    yield b"[" * 3_000_000, "application/json"


def queries() -> Iterator[str]:
    """Yield URLs whose queries contain numbers that no page requests."""
    for number in NUMBERS:
        yield f"/api/series?packet=imu&field=rate&from={number}&to=1"
        yield f"/api/series?packet=imu&field=rate&from=0&to={number}"
        yield f"/api/series?packet=imu&field=rate&from=0&to=1&points={number}&component={number}"
        yield f"/api/series?packet={number}&field={number}"
        yield f"/api/track?at={number}"
        yield f"/api/passes?at={number}&days={number}&station={number}"
        yield f"/api/file?name={number}"
        yield f"/api/frame?sequence={number}"
        yield f"/api/frame.png?sequence={number}"
        yield f"/page/{number}"
    yield from (
        "/api/series",
        "/api/track",
        "/api/live",
        "/api/passes?at=1&days=1",
        "/api/file?name=../config.yaml",
        "/api/file?name=/etc/passwd",
        "/page/../server.py",
        "/page/%2e%2e/server.py",
        "//",
        "/%00",
    )


@pytest.mark.filterwarnings("ignore:.*:RuntimeWarning")
def test_no_body_of_a_command_gives_status_500_and_only_commands_are_sent(folder: Path) -> None:
    sent: list[bytes] = []

    def send(packet: bytes) -> dict[str, Any]:
        sent.append(packet)
        return {"obeyed": 1, "text": "done"}

    async def ask(client: TestClient[Any, Any]) -> list[tuple[int, str]]:
        own = str(client.make_url("/")).rstrip("/")
        found = []
        for body, kind in bodies(np.random.default_rng(SEED)):
            for path in ("/api/words", "/api/command"):
                headers = {"Origin": own, **({"Content-Type": kind} if kind else {})}
                async with client.post(path, data=io.BytesIO(body), headers=headers) as answer:
                    found.append((answer.status, f"{path} {kind} {body[:200]!r}"))
        return found

    found = asked(folder, ask, send)
    assert len(found) > 1000
    assert [text for status, text in found if status not in {200, 400, 413}] == []
    for packet in sent:
        commands.unpack(packet)
    assert 0 < len(sent) < len(found) / 2


def test_no_query_gives_status_500(folder: Path) -> None:
    async def ask(client: TestClient[Any, Any]) -> list[tuple[int, str]]:
        found = []
        for path in queries():
            async with client.get(path) as answer:
                found.append((answer.status, path[:120]))
        return found

    found = asked(folder, ask)
    assert [text for status, text in found if status >= 500] == []
    assert {200, 400, 404} <= {status for status, _ in found}


@pytest.mark.parametrize("at", ODD)
def test_no_message_on_the_websocket_ends_its_reader(at: str) -> None:
    cursor, span = PageCursor(), (0, 10 * 10**9)
    for text in (
        at,
        f'{{"at": {at}}}',
        f'{{"at": {at}, "speed": 1}}',
        f'{{"at": 1, "speed": {at}}}',
        f'{{"live": {at}}}',
    ):
        cursor.obey(text, 5.0)
        assert 0 <= cursor.at_ns(span, 6.0) <= span[1]
        assert math.isfinite(cursor.speed)
    cursor.obey(NESTED, 5.0)
