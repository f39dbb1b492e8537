"""A Yamcs process, and what a study asks of it by its HTTP interface; both on loopback alone."""

from __future__ import annotations

import base64
import importlib.util
import json
import re
import shutil
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
from ground.yamcs import INSTANCE, LINK_SOURCE, USER, USERS

_BUNDLE = "fprime_yamcs_bundle"
_START_S = 120.0
_END_S = 30.0
_LONGEST_S = 300.0
_TROUBLE = ("WARNING", "SEVERE", "Exception")


def missing() -> str:
    """Return what this machine lacks to run Yamcs, empty when nothing."""
    if shutil.which("java") is None:
        return "there is no Java: apt-get install default-jre-headless"
    if importlib.util.find_spec(_BUNDLE) is None:
        return "there is no Yamcs: pip install 'knightcube-flight[interop]'"
    return ""


def jars() -> Path:
    """Return what stands for all archives of the bundle on a class path."""
    found = importlib.util.find_spec(_BUNDLE)
    assert found is not None
    assert found.submodule_search_locations
    return Path(found.submodule_search_locations[0]) / "lib" / "*"


def compile_link(folder: Path) -> None:
    """Compile the data link of a configuration. Raises RuntimeError with the compiler's words."""
    compiler = ["java", "-cp", str(jars()), "-m", "jdk.compiler/com.sun.tools.javac.Main", "-proc:none"]
    command = [*compiler, "-d", str(folder), str(folder / LINK_SOURCE)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"the data link cannot be compiled:\n{done.stdout}{done.stderr}")


def words(folder: Path) -> list[str]:
    """Return the command that starts Yamcs on the configuration in a folder."""
    places = ["--etc-dir", str(folder / "etc"), "--data-dir", str(folder / "data")]
    flags = ["-Djava.awt.headless=true", "-Djava.net.preferIPv4Stack=true", "-XX:TieredStopAtLevel=1"]
    return ["java", *flags, "-cp", f"{jars()}:{folder}", "org.yamcs.YamcsServer", *places, "--no-color"]


def troubles(log: str) -> list[str]:
    """Return the lines of a log that warn or worse."""
    return [line for line in log.splitlines() if any(word in line for word in _TROUBLE)]


@contextmanager
def serving(folder: Path, http_port: int) -> Iterator[Yamcs]:
    """Start Yamcs on a configuration, yield it when it answers, and end it. Its log is `folder/log`."""
    log = folder / "log"
    compile_link(folder)
    with log.open("w") as out:
        process = subprocess.Popen(words(folder), stdout=out, stderr=subprocess.STDOUT)
    try:
        server = Yamcs(f"http://127.0.0.1:{http_port}/api", process, log, _credentials(folder))
        server.wait()
        yield server
    finally:
        process.terminate()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def basic(password: str) -> str:
    """Return the header by which the user states a password."""
    return "Basic " + base64.b64encode(f"{USER}:{password}".encode()).decode()


def _credentials(folder: Path) -> str:
    found = re.search(r'password: "(\w+)"', (folder / USERS).read_text(encoding="utf-8"))
    assert found is not None
    return basic(found[1])


@dataclass(frozen=True)
class Yamcs:
    """A running Yamcs."""

    url: str
    process: subprocess.Popen[bytes]
    log: Path
    credentials: str

    def wait(self) -> None:
        """Wait until the instance runs. Raises RuntimeError with the end of its log where it does not."""
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
        """Return the answer to GET, or to POST of a body."""
        return json.loads(self.raw(path, body))

    def raw(self, path: str, body: dict[str, Any] | None = None) -> bytes:
        """Return the bytes of an answer."""
        data = None if body is None else json.dumps(body).encode()
        headers = {"Content-Type": "application/json", "Authorization": self.credentials}
        request = urllib.request.Request(self.url + path, data, headers)
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(request, timeout=_LONGEST_S) as answer:
            return bytes(answer.read())

    def link_up(self) -> bool:
        """Return whether its data link is connected."""
        return bool(self.ask(f"/links/{INSTANCE}/gateway")["status"] == "OK")

    def command(self, name: str, arguments: dict[str, Any]) -> str:
        """Issue a command; return its identifier."""
        path = f"/processors/{INSTANCE}/realtime/commands/{SPACE}/{name}"
        texts = {key: str(value) for key, value in arguments.items()}
        return str(self.ask(path, {"args": texts})["id"])

    def history(self, command: str) -> dict[str, Any]:
        """Return the command history of a command by attribute."""
        entry = self.ask(f"/archive/{INSTANCE}/commands/{quote(command)}")
        found = {}
        for attribute in entry.get("attr", entry.get("attributes", [])):
            value = attribute["value"]
            kind = value["type"]
            key = {"STRING": "stringValue", "SINT32": "sint32Value", "ENUMERATED": "stringValue"}.get(kind)
            found[attribute["name"]] = value.get(key) if key else value
        return found

    def packets(self) -> bytes:
        """Return all packets of the archive, one behind the other."""
        return self.raw(f"/archive/{INSTANCE}:exportPackets")

    def values(self, names: list[str]) -> Iterator[dict[str, Any]]:
        """Yield each archived packet's values of some parameters: name, generation time, raw value."""
        ids = [{"name": f"/{SPACE}/{name}"} for name in names]
        text = self.raw(f"/archive/{INSTANCE}:streamParameterValues", {"ids": ids}).decode()
        decoder, at = json.JSONDecoder(), 0
        while at < len(text):
            entry, at = decoder.raw_decode(text, at)
            while at < len(text) and text[at].isspace():
                at += 1
            yield from entry.get("parameter", ())
