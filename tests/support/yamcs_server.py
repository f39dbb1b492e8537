"""A Yamcs process and its HTTP interface, both only on loopback."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ground.xtce import SPACE
from ground.yamcs import INSTANCE, USER, USERS, command_line, compile_link, missing
from tests.support.linked_flight import end

__all__ = ["Yamcs", "basic", "credentials", "missing", "serving", "troubles"]

_START_S = 120.0
_LONGEST_S = 300.0
_TROUBLE = ("WARNING", "SEVERE", "Exception")


def troubles(log: str) -> list[str]:
    """Return the lines of a log that are warnings or errors."""
    return [line for line in log.splitlines() if any(word in line for word in _TROUBLE)]


@contextmanager
def serving(folder: Path, http_port: int) -> Iterator[Yamcs]:
    """Start Yamcs with a configuration, yield the server when it responds, and end it after the block.

    The log of the server is `folder/log`.
    """
    log = folder / "log"
    compile_link(folder)
    with log.open("w") as out:
        process = subprocess.Popen(command_line(folder), stdout=out, stderr=subprocess.STDOUT)
    try:
        server = Yamcs(f"http://127.0.0.1:{http_port}/api", process, log, credentials(folder))
        server.wait()
        yield server
    finally:
        end(process)


def basic(password: str) -> str:
    """Return the HTTP authorisation header with the user's password."""
    return "Basic " + base64.b64encode(f"{USER}:{password}".encode()).decode()


def credentials(folder: Path) -> str:
    """Return the HTTP authorisation header with the password in a folder's configuration."""
    found = re.search(r'password: "(\w+)"', (folder / USERS).read_text(encoding="utf-8"))
    assert found is not None
    return basic(found[1])


@dataclass(frozen=True)
class Yamcs:
    """A running Yamcs server."""

    url: str
    process: subprocess.Popen[bytes]
    log: Path
    credentials: str

    def wait(self) -> None:
        """Wait until the instance runs. Raises RuntimeError with the end of the log if it does not start."""
        until = time.monotonic() + _START_S
        while time.monotonic() < until and self.process.poll() is None:
            try:
                if self.ask(f"/instances/{INSTANCE}")["state"] == "RUNNING":
                    return
            except (urllib.error.URLError, ConnectionError):
                pass
            time.sleep(0.2)
        raise RuntimeError(f"Yamcs does not answer:\n{self.log.read_text()[-2000:]}")

    def ask(self, path: str, body: dict[str, Any] | None = None) -> Any:
        """Return the response to a GET request, or to a POST request with `body`."""
        return json.loads(self.raw(path, body))

    def raw(self, path: str, body: dict[str, Any] | None = None) -> bytes:
        """Return a response as bytes."""
        data = None if body is None else json.dumps(body).encode()
        headers = {"Content-Type": "application/json", "Authorization": self.credentials}
        request = urllib.request.Request(self.url + path, data, headers)
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(request, timeout=_LONGEST_S) as answer:
            return bytes(answer.read())

    def link_up(self) -> bool:
        """Return whether the instance's data link is connected."""
        return bool(self.ask(f"/links/{INSTANCE}/gateway")["status"] == "OK")

    def command(self, name: str, arguments: dict[str, Any]) -> str:
        """Issue a command; return its identifier."""
        path = f"/processors/{INSTANCE}/realtime/commands/{SPACE}/{name}"
        texts = {key: str(value) for key, value in arguments.items()}
        return str(self.ask(path, {"args": texts})["id"])

    def history(self, command: str) -> dict[str, Any]:
        """Return the entries of a command in the command history, by attribute."""
        entry = self.ask(f"/archive/{INSTANCE}/commands/{quote(command)}")
        found = {}
        for attribute in entry.get("attr", entry.get("attributes", [])):
            value = attribute["value"]
            kind = value["type"]
            key = {"STRING": "stringValue", "SINT32": "sint32Value", "ENUMERATED": "stringValue"}.get(kind)
            found[attribute["name"]] = value.get(key) if key else value
        return found

    def packets(self) -> bytes:
        """Return all packets of the archive, concatenated."""
        return self.raw(f"/archive/{INSTANCE}:exportPackets")

    def values(self, names: list[str]) -> Iterator[dict[str, Any]]:
        """Yield name, generation time and raw value of each archived value of the given parameters."""
        ids = [{"name": f"/{SPACE}/{name}"} for name in names]
        text = self.raw(f"/archive/{INSTANCE}:streamParameterValues", {"ids": ids}).decode()
        decoder, at = json.JSONDecoder(), 0
        while at < len(text):
            entry, at = decoder.raw_decode(text, at)
            while at < len(text) and text[at].isspace():
                at += 1
            yield from entry.get("parameter", ())
