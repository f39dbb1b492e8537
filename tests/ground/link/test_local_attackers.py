"""Tests that gateway and console refuse web pages and other users of the same machine.

Gateway and console run as commands on one link. The test receives the frames of the link by a socket, and
authenticates them with the satellite's keys. The tests in Chromium need the Debian package `chromium` and the
Python extra `playwright`.
"""

from __future__ import annotations

import http.client
import json
import multiprocessing
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flight.link.commands import ChangeMode, CommandPacker, Ping
from flight.link.events import Mode
from flight.link.frames import TELECOMMAND_MASK
from flight.link.process.station import parser_of
from flight.link.security import COMMAND_SPIS, Gate, Vault
from ground.link.gateway import token_path
from ground.link.terminal import DEFAULTS, make_keys
from tests.support import browser

ROOT = Path(__file__).resolve().parents[3]
SAFE = CommandPacker().pack(ChangeMode(Mode.SAFE, "attack"), 1)
COMMAND = json.dumps({"command": "safe", "values": {"reason": "attack"}})
PING = CommandPacker().pack(Ping(), 1)[:2]
PATIENCE_S = 60.0
NOBODY = 65534


@dataclass
class Ground:
    """A gateway and a console that share a folder of keys, and the satellite's end of their link."""

    gateway: int
    console: int
    url: str
    keys: Path
    processes: list[int]
    gate: Gate
    frames: socket.socket

    def obeyed(self, seconds: float = 0.5) -> list[bytes]:
        """Return the commands, without pings, that arrive until the link is silent."""
        found, until = list[bytes](), time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            self.frames.settimeout(left)
            with suppress(TimeoutError):
                packet = self.gate.admit(self.frames.recv(4096)).data
                if packet[:2] != PING:
                    found.append(packet)
                    until = time.monotonic() + 0.1
        return found


@pytest.fixture(scope="module")
def ground() -> Iterator[Ground]:
    """Start gateway and console in a folder that every user of the machine can enter."""
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="knightcube-")))
        satellite, keys = make_keys(place / "keys")
        for folder in (place, place / "keys", keys):
            folder.chmod(0o755)
        frames = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        frames.bind(("127.0.0.1", 0))
        link = ("--link", f"127.0.0.1:{frames.getsockname()[1]}", "--keys", keys)
        serve, console = (
            stack.enter_context(_program("gateway", *link, "--serve", "127.0.0.1:0")),
            stack.enter_context(_program("console", *link, "--port", "0")),
        )
        (port,), (url, at) = _said(serve, r"127\.0\.0\.1:(\d+)"), _said(console, r"(http://[^:]+:(\d+)\S+)")
        gate = Gate(Vault(satellite), COMMAND_SPIS, parser_of(DEFAULTS.spacecraft), TELECOMMAND_MASK)
        yield Ground(int(port), int(at), url, keys, [serve.pid, console.pid], gate, frames)


@contextmanager
def _program(*words: object) -> Iterator[subprocess.Popen[str]]:
    line = [sys.executable, "-m", "flight", *map(str, words)]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        try:
            yield process
        finally:
            process.terminate()
            process.communicate(timeout=PATIENCE_S)


def _said(process: subprocess.Popen[str], pattern: str) -> tuple[str, ...]:
    assert process.stdout is not None
    found = re.search(pattern, process.stdout.readline())
    assert found is not None
    return found.groups()


@pytest.fixture(scope="module")
def cookie(ground: Ground) -> str:
    """Open the address of the console as the operator's browser does, and return its cookie."""
    status, _, cookie = _asked(ground.console, "GET", ground.url.partition(str(ground.console))[2])
    assert status == 200
    return cookie.partition(";")[0]


def _asked(
    port: int, method: str, path: str, headers: dict[str, str] | None = None, body: str | None = None
) -> tuple[int, str, str]:
    """Return the status, the text and the cookie of a response."""
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    try:
        line.request(method, path, body, headers or {})
        answer = line.getresponse()
        return answer.status, answer.read().decode(), answer.headers.get("Set-Cookie", "")
    finally:
        line.close()


SOCKET = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}
REQUESTS: list[tuple[str, str, dict[str, str], str | None]] = [
    ("GET", "/", {}, None),
    ("GET", "/api/table", {}, None),
    ("GET", "/api/live", SOCKET, None),
    ("POST", "/api/words", {}, COMMAND),
    ("POST", "/api/command", {}, COMMAND),
    ("POST", "/api/command", {"Content-Type": "text/plain"}, COMMAND),
    ("POST", "/api/command", {"Content-Type": "application/x-www-form-urlencoded"}, COMMAND),
]


@pytest.mark.parametrize(
    "forged",
    [
        {"Host": "evil.example:PORT"},
        {"Host": "evil.example:PORT", "Origin": "http://evil.example:PORT"},
        {"Origin": "http://evil.example"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "null"},
        {"Host": "localhost:PORT", "Origin": "http://127.0.0.1:PORT"},
    ],
    ids=str,
)
def test_no_forged_request_is_obeyed_even_by_the_operators_browser(
    ground: Ground, cookie: str, forged: dict[str, str]
) -> None:
    """Requests of the operator's browser are refused if they come from a rebound name or another origin."""
    headers = {name: text.replace("PORT", str(ground.console)) for name, text in forged.items()}
    for method, path, more, body in REQUESTS:
        status, text, _ = _asked(ground.console, method, path, {**headers, **more, "Cookie": cookie}, body)
        assert (status, "token" in text) == (403, False), path
    assert ground.obeyed() == []


@pytest.mark.parametrize("session", ["", "knightcube-console-PORT=", "knightcube-console-PORT=" + "A" * 43])
def test_without_the_token_nothing_is_obeyed(ground: Ground, cookie: str, session: str) -> None:
    """A program on the same machine without the token is refused, whatever Host and Origin it states."""
    del cookie  # the token in the printed address is already used
    used = ground.url.partition("?")[2]
    headers = {
        "Origin": f"http://127.0.0.1:{ground.console}",
        "Cookie": session.replace("PORT", str(ground.console)),
    }
    for method, path, more, body in REQUESTS:
        for query in ("", f"?{used}", "?token="):
            status, _, session_cookie = _asked(ground.console, method, path + query, headers | more, body)
            assert (status, session_cookie) == (401, ""), path
    assert ground.obeyed() == []


@pytest.mark.parametrize(
    "begin",
    [
        b"POST / HTTP/1.1\r\nHost: evil.example\r\nOrigin: http://evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: AA==\r\n\r\n",
        b"\n",
        b"0" * 64 + b"\n",
        b"0" * 65,
        bytes(7000),
        b"",
    ],
    ids=repr,
)
def test_a_stream_without_the_token_is_closed_and_not_obeyed(ground: Ground, begin: bytes) -> None:
    with socket.create_connection(("127.0.0.1", ground.gateway), PATIENCE_S) as line:
        with suppress(ConnectionError):
            line.sendall(begin + SAFE)
        assert _rest(line) == b""
    assert ground.obeyed() == []


def _rest(line: socket.socket) -> bytes:
    with suppress(ConnectionError):
        return line.recv(4096)
    return b""


def test_the_operator_is_obeyed(ground: Ground, cookie: str) -> None:
    """An authorised request is accepted.

    This shows that the requests in the other tests are refused because of their sender.
    """
    with socket.create_connection(("127.0.0.1", ground.gateway), PATIENCE_S) as line:
        line.sendall(token_path(ground.keys, ground.gateway).read_bytes() + SAFE)
        assert len(ground.obeyed(PATIENCE_S)) == 1
    page = http.client.HTTPConnection("127.0.0.1", ground.console, timeout=PATIENCE_S)
    origin = f"http://127.0.0.1:{ground.console}"
    page.request("POST", "/api/command", COMMAND, {"Cookie": cookie, "Origin": origin})
    assert len(ground.obeyed(PATIENCE_S)) == 1
    page.close()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
def test_another_user_finds_no_token(ground: Ground) -> None:
    """Another user cannot read a token, even if all users may enter the key folders.

    No command creates a folder that all users may enter.
    """
    places = [token_path(ground.keys, ground.gateway), *sorted(ground.keys.glob("spi-*"))]
    places += [Path(f"/proc/{pid}/{name}") for pid in ground.processes for name in ("environ", "mem")]
    token = places[0].read_text(encoding="ascii").strip()
    secrets = (token, ground.url.partition("token=")[2])
    with multiprocessing.get_context("fork").Pool(1, _become_nobody) as pool:
        assert pool.map(_readable, places) == [""] * len(places)
        lines = [Path(f"/proc/{pid}/cmdline") for pid in ground.processes]
        shown = "".join(pool.map(_readable, lines))
    assert "gateway" in shown
    assert not any(secret in shown for secret in secrets)


def _become_nobody() -> None:
    os.setgroups([])
    os.setgid(NOBODY)
    os.setuid(NOBODY)


def _readable(path: Path) -> str:
    """Return the text of a file, or an empty text if reading is not permitted."""
    with suppress(OSError):
        return path.read_bytes().decode(errors="replace")
    return ""


_REQUESTS = """async ([page, gateway, command, packet]) => {
  const late = () => new Promise((done) => setTimeout(done, 1000, "late"));
  const tried = (promise) => Promise.race([promise.then((one) => one.status, () => "refused"), late()]);
  const found = [];
  for (const type of ["text/plain", "application/x-www-form-urlencoded", "application/json"])
    for (const mode of ["no-cors", "cors"]) {
      const all = { method: "POST", mode, credentials: "include", body: command };
      found.push(await tried(fetch(`${page}api/command`, { ...all, headers: { "Content-Type": type } })));
    }
  navigator.sendBeacon(`${page}api/command`, command);
  for (let shift = 0; shift < 7; shift++) {
    const body = new Uint8Array([...Array(20000 + shift).fill(0), ...packet]);
    await tried(fetch(gateway, { method: "POST", mode: "no-cors", body }));
  }
  for (const url of [page, gateway]) {
    const line = new WebSocket(`${url.replace("http", "ws")}api/live`);
    const shown = new Promise((done) => {
      line.onopen = () => line.send(new Uint8Array(packet));
      line.onmessage = () => done("answered");
      line.onclose = () => done("refused");
    });
    found.push(await Promise.race([shown, late()]));
  }
  return found;
}"""
"""JavaScript of a page that sends requests to gateway and console.

The request begins with zeros, which a reader could read as packets of 7 bytes.
"""
_FORM = """(page) => {
  const form = document.createElement("form");
  Object.assign(form, { method: "post", action: `${page}api/command`, enctype: "text/plain" });
  form.append(Object.assign(document.createElement("input"), {
    name: '{"command": "safe", "values": {"reason": "', value: '"}}' }));
  document.body.append(form);
  form.submit();
}"""
_FRAME = """(url) => new Promise((done) => {
  const frame = Object.assign(document.createElement("iframe"), { src: url, onload: done });
  Object.assign(frame.style, { position: "fixed", inset: 0, width: "100%", height: "100%", opacity: 0.01 });
  document.body.append(frame);
})"""
_OWN = """([page, command]) => {
  fetch(`${page}api/command`, { method: "POST", body: command });
}"""


@pytest.fixture(scope="module")
def context(ground: Ground, cookie: str) -> Iterator[Any]:
    """Open Chromium with the session of the operator. The host name evil.example resolves to 127.0.0.1."""
    if lacks := browser.missing():
        pytest.skip(lacks)
    rules = "--host-resolver-rules=MAP evil.example 127.0.0.1"
    # Recent browsers ask the user before a web page may connect to loopback. Older browsers do not ask.
    with browser.browsing(rules, "--disable-features=LocalNetworkAccessChecks") as chromium:
        opened = chromium.new_context(viewport={"width": 1000, "height": 800})
        name, _, value = cookie.partition("=")
        address = f"http://127.0.0.1:{ground.console}"
        opened.add_cookies([{"name": name, "value": value, "url": address, "sameSite": "Strict"}])
        yield opened


def _attacked(ground: Ground, context: Any, origin: str, host: str) -> list[object]:
    """Let a page at `origin` send its requests to both programs at `host`, and return the results."""
    page = context.new_page()
    page.goto(origin)
    console, gateway = (f"http://{host}:{port}/" for port in (ground.console, ground.gateway))
    found = page.evaluate(_REQUESTS, [console, gateway, COMMAND, list(SAFE)])
    page.evaluate(_FORM, console)
    page.wait_for_timeout(300)
    page.close()
    return list(found)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["127.0.0.1", "evil.example"])
def test_another_page_of_the_operators_browser_is_not_obeyed(ground: Ground, context: Any, name: str) -> None:
    """Pages on another port of the same host (with cookies), and on another site, are refused."""
    with browser.another_origin() as url:
        found = _attacked(ground, context, url.replace("127.0.0.1", name), "127.0.0.1")
    assert set(found) <= {0, "refused"}, "0 is the status of an answer that the page may not read"
    assert ground.obeyed() == []


@pytest.mark.slow
def test_a_page_whose_name_is_rebound_to_loopback_is_not_obeyed(ground: Ground, context: Any) -> None:
    """A page whose name is rebound to loopback can read all responses, but its requests are refused."""
    origin = f"http://evil.example:{ground.console}/start"
    context.route(origin, lambda route: route.fulfill(content_type="text/html", body="<!doctype html>"))
    found = _attacked(ground, context, origin, "evil.example")
    assert found == [403] * 6 + ["refused"] * 2
    assert ground.obeyed() == []


@pytest.mark.slow
def test_clicks_on_a_framed_console_are_not_obeyed(ground: Ground, context: Any) -> None:
    with browser.another_origin() as url:
        page = context.new_page()
        page.goto(url)
        page.evaluate(_FRAME, f"http://127.0.0.1:{ground.console}/")
        for x in range(50, 1000, 100):
            for y in range(50, 800, 100):
                page.mouse.click(x, y)
        assert [frame.url for frame in page.frames[1:]] == ["chrome-error://chromewebdata/"]
        page.close()
    assert ground.obeyed() == []


@pytest.mark.slow
def test_the_operators_own_page_is_obeyed(ground: Ground, context: Any) -> None:
    page = context.new_page()
    address = f"http://127.0.0.1:{ground.console}/"
    page.goto(address)
    page.evaluate(_OWN, [address, COMMAND])
    assert len(ground.obeyed(PATIENCE_S)) == 1
    page.close()
