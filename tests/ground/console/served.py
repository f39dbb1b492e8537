"""A server of the console for tests, and its responses to a client."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from aiohttp import CookieJar
from aiohttp.test_utils import TestClient, TestServer

from ground.console.commanding import CommandForms, RunFiles
from ground.console.history import History
from ground.console.server import Access, Console, application
from ground.console.surroundings import FlightSurroundings
from ground.watch import LogTail


def asked(
    folder: Path,
    ask: Callable[[TestClient[Any, Any]], Awaitable[Any]],
    send: Any = None,
    access: Access | None = None,
) -> Any:
    """Serve a run; return the responses to a client, which is authorised by default."""

    async def talk(history: History) -> Any:
        place = FlightSurroundings.of(folder / "config.yaml")
        console = Console(
            folder.name, LogTail(folder), history, place, CommandForms(send), files=RunFiles(folder)
        )
        console.read()
        door = access or Access(lambda token: None)
        server = TestServer(application(console, door), host="127.0.0.1")
        # The test client must accept cookies from hosts with numeric addresses.
        async with TestClient(server, cookie_jar=CookieJar(unsafe=True)) as client:
            if access is None:
                async with client.get("/", params={"token": door.token}) as answer:
                    assert answer.status == 200
            return await ask(client)

    with History() as history:
        return asyncio.run(talk(history))
