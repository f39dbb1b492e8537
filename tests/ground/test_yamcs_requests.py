"""Tests of the start of Yamcs and of the requests for its timeline, with test doubles instead of Java."""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest
import yaml

from ground import yamcs
from ground.passes import Pass, Station
from knightcube.errors import KnightCubeError, UsageError

BEGIN = datetime(2026, 3, 20, 12, 0, 0, tzinfo=UTC)
BERLIN = Station(name="Berlin", latitude_deg=52.5, longitude_deg=13.4)
RISE = datetime(2026, 3, 20, 13, 0, 5, 700_000, tzinfo=UTC)


def a_pass(sunlit: float = 0.6) -> Pass:
    """Return a pass of 600.4 s."""
    top, end = RISE + timedelta(seconds=300), RISE + timedelta(seconds=600.4)
    return Pass(BERLIN, RISE, top, end, (10.4, 85.6, 170.0), 44.6, 9e5, sunlit, -12.4)


class Timeline:
    """Yamcs whose timeline has given items, at most two in one answer."""

    def __init__(self, items: list[dict[str, Any]], *, views: bool) -> None:
        self.items, self.views = items, views
        self.asked: list[tuple[str, Any, str | None]] = []

    def ask(self, path: str, body: Mapping[str, Any] | None = None, method: str | None = None) -> Any:
        self.asked.append((path, body, method))
        if method == "DELETE":
            return {}
        if path.endswith("/views"):
            return {"views": [{"name": "passes"}]} if self.views else {}
        if path.endswith("/bands"):
            return {"id": f"band-{body and body['name']}"}
        if body is None:
            query = parse_qs(urlsplit(path).query)
            first = int(query.get("next", ["0"])[0])
            answer: dict[str, Any] = {"items": self.items[first : first + 2]}
            if first + 2 < len(self.items):
                answer["continuationToken"] = str(first + 2)
            return answer
        return {}


def prediction(*passes: Pass) -> Any:
    return SimpleNamespace(begin=BEGIN, end=BEGIN + timedelta(days=1), passes=lambda stations: list(passes))


def test_a_pass_is_an_item_with_its_light_and_the_commands_that_point_to_the_station() -> None:
    session: Any = Timeline([], views=True)
    yamcs.add_passes(session, "one", prediction(a_pass(), a_pass(0.5)), [BERLIN])
    first, second = (body for path, body, _ in session.asked if path == "/timeline/one/items")
    assert first == {
        "source": "rdb",
        "type": "EVENT",
        "name": "Berlin, 45 deg",
        "start": "2026-03-20T13:00:05+00:00",
        "duration": "601s",  # from the whole second of the rise to the set
        "tags": ["pass"],
        "description": (
            "azimuths 10 to 86 to 170 deg; satellite in sunlight; Sun -12 deg high; "
            "schedule 2026-03-20T12:58:05 point ground 52.5deg 13.4deg; "
            "schedule 2026-03-20T13:10:06 point nadir"
        ),
    }
    assert "satellite in shadow" in second["description"]


def test_earlier_passes_of_the_span_are_deleted_from_all_pages_and_other_items_stay() -> None:
    items: list[dict[str, Any]] = [
        {"id": "a", "tags": ["pass"]},
        {"id": "b", "tags": ["holiday"]},
        {"id": "c"},
        {"id": "d", "tags": ["x", "pass"]},
        {"id": "e", "tags": ["pass"]},
    ]
    session: Any = Timeline(items, views=True)
    yamcs.add_passes(session, "one", prediction(), [BERLIN])
    deleted = [path for path, _, method in session.asked if method == "DELETE"]
    assert deleted == [f"/timeline/one/items/{name}" for name in "ade"]
    pages = [urlsplit(path) for path, body, method in session.asked if "items?" in path]
    query = parse_qs(pages[0].query)
    assert query == {
        "start": ["2026-03-20T12:00:00+00:00"],
        "stop": ["2026-03-21T12:00:00+00:00"],
        "limit": ["500"],
    }
    assert [parse_qs(page.query).get("next") for page in pages] == [None, ["2"], ["4"]]


@pytest.mark.parametrize("views", [False, True])
def test_a_view_of_the_timeline_is_added_at_the_first_call_only(views: bool) -> None:
    session: Any = Timeline([], views=views)
    yamcs.add_passes(session, "one", prediction(), [BERLIN])
    posted = [(path, body) for path, body, _ in session.asked if body is not None]
    if views:
        assert posted == []
        return
    ruler, band, view = posted
    assert ruler[0] == band[0] == "/timeline/one/bands"
    assert (ruler[1]["type"], ruler[1]["properties"]) == ("TIME_RULER", {"timezone": "UTC"})
    assert (band[1]["type"], band[1]["tags"], band[1]["shared"]) == ("ITEM_BAND", ["pass"], True)
    assert view == ("/timeline/one/views", {"name": "passes", "bands": ["band-UTC", "band-passes"]})


# Requests.


@contextmanager
def server() -> Iterator[tuple[str, list[tuple[Any, ...]]]]:
    """Yield the address of an HTTP server that repeats requests as JSON, and the requests."""
    seen: list[tuple[Any, ...]] = []

    class Handler(BaseHTTPRequestHandler):
        def _answer(self) -> None:
            length = int(self.headers.get("Content-Length", 0))
            body = self.rfile.read(length).decode()
            words = self.headers["Authorization"], self.headers["Content-Type"]
            seen.append((self.command, self.path, body, *words))
            self.send_response(404 if "none" in self.path else 200)
            self.end_headers()
            self.wfile.write(json.dumps({"path": self.path}).encode())

        do_GET = do_POST = do_DELETE = _answer

        def log_message(self, *words: Any) -> None: ...

    made = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://127.0.0.1:{made.server_port}/api", seen
    finally:
        made.shutdown()
        thread.join()
        made.server_close()


def test_requests_have_password_body_and_method() -> None:
    with server() as (url, seen):
        session = yamcs.Session(url, "admin", "1a2b")
        assert session.ask("/one") == {"path": "/api/one"}
        session.ask("/two", {"x": [1]})
        session.ask("/three", method="DELETE")
        with pytest.raises(OSError, match="404"):
            session.ask("/none")
    words = "Basic " + base64.b64encode(b"admin:1a2b").decode(), "application/json"
    assert seen[:3] == [
        ("GET", "/api/one", "", *words),
        ("POST", "/api/two", '{"x": [1]}', *words),
        ("DELETE", "/api/three", "", *words),
    ]


# Programs and files.


@pytest.mark.parametrize(
    ("java", "bundle", "said"),
    [
        (None, True, "Java is missing: apt-get install default-jre-headless"),
        ("/usr/bin/java", False, "Yamcs is missing: pip install 'knightcube-flight[interop]'"),
        ("/usr/bin/java", True, ""),
    ],
)
def test_missing_software_is_named_with_its_cure(
    java: str | None, bundle: bool, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ground.yamcs.shutil.which", lambda name: java if name == "java" else None)
    monkeypatch.setattr(
        "ground.yamcs.importlib.util.find_spec", lambda name: object() if bundle and "yamcs" in name else None
    )
    assert yamcs.missing() == said


@pytest.fixture
def bundle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the class path of an artificial bundle of Yamcs."""
    spec = SimpleNamespace(submodule_search_locations=[str(tmp_path / "bundle")])
    monkeypatch.setattr("ground.yamcs.importlib.util.find_spec", lambda name: spec)
    return f"{tmp_path}/bundle/lib/*"


def test_yamcs_starts_with_the_archives_the_compiled_link_and_its_folders(bundle: str) -> None:
    words = yamcs.command_line(Path("/srv/mc"))
    assert words[0] == "java"
    place = words.index("-cp")
    assert words[place + 1] == f"{bundle}:/srv/mc"
    assert words[place + 2 :] == [
        "org.yamcs.YamcsServer", "--etc-dir", "/srv/mc/etc", "--data-dir", "/srv/mc/data", "--no-color",
    ]  # fmt: skip


@pytest.mark.parametrize("status", [0, 1])
def test_the_data_link_is_compiled_into_the_folder(
    status: int, bundle: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []

    def run(command: list[str], **settings: Any) -> Any:
        commands.append(command)
        assert settings["capture_output"]
        return SimpleNamespace(returncode=status, stdout="out ", stderr="wrong line")

    monkeypatch.setattr("ground.yamcs.subprocess.run", run)
    folder = tmp_path / "new" / "mc"
    if status:
        with pytest.raises(KnightCubeError, match="the data link cannot be compiled:\nout wrong line"):
            yamcs.compile_link(folder)
    else:
        yamcs.compile_link(folder)
    source = folder / "GatewayLink.java"
    assert "public class GatewayLink extends TcpTcTmDataLink" in source.read_text()
    (words,) = commands
    assert words[words.index("-cp") + 1] == bundle
    assert words[-3:] == ["-d", str(folder), str(source)]


def test_folders_that_cannot_be_written_and_wrong_addresses_are_one_line(tmp_path: Path, bundle: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="file/mc: cannot be written: Not a directory"):
        yamcs.compile_link(tmp_path / "file" / "mc")
    with pytest.raises(UsageError, match="file/mc: cannot be written: Not a directory"):
        yamcs.write(tmp_path / "file" / "mc")
    with pytest.raises(UsageError, match="nowhere: give HOST:PORT of the gateway"):
        yamcs.write(tmp_path / "mc", "nowhere")
    assert not (tmp_path / "mc").exists()


def test_the_configuration_names_gateway_token_folders_and_epoch(tmp_path: Path) -> None:
    yamcs.write(tmp_path, "127.0.0.1:5001", 8099, "2026-03-20T12:00:00", tmp_path / "keys")
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} == {
        "etc", "data", "recorded", "down", "up", "stacks", "displays",
    }  # fmt: skip
    server_settings = yaml.safe_load((tmp_path / "etc" / "yamcs.yaml").read_text())
    assert server_settings["services"][0]["args"] == {"address": "127.0.0.1", "port": 8099}
    assert server_settings["instances"] == ["knightcube"]
    buckets = {one["name"]: one["path"] for one in server_settings["buckets"]}
    assert buckets == {name: f"{tmp_path}/{name}" for name in ("down", "up", "stacks", "displays")}
    assert len(server_settings["secretKey"]) == 32
    instance = yaml.safe_load((tmp_path / "etc" / "yamcs.knightcube.yaml").read_text())
    gateway, recorded = instance["dataLinks"]
    assert (gateway["host"], gateway["port"], gateway["enabledAtStartup"]) == ("127.0.0.1", 5001, True)
    assert gateway["tokenFile"] == str(tmp_path / "keys" / "gateway-5001.token")
    assert recorded["incomingDir"] == f"{tmp_path}/recorded"
    times = gateway["packetPreprocessorArgs"]["timeEncoding"]
    assert times["epochUTC"] == "2026-03-20T12:00:00Z"
    assert 'password: "' in (tmp_path / "etc" / "users.yaml").read_text()
    assert len(yamcs.password_in(tmp_path)) == 32
    first = yamcs.password_in(tmp_path)
    yamcs.write(tmp_path)
    assert yamcs.password_in(tmp_path) != first
    streams = (tmp_path / "etc" / "files.sql").read_text()
    # The CFDP unit follows the primary header (6 bytes) and the secondary header (9 bytes).
    assert "substring(packet, 15) as pdu" in streams


def test_a_header_of_file_packets_is_a_telecommand_with_zero_time(tmp_path: Path) -> None:
    """The header has version 0, type 1, sequence flags 3, count 0 and length 0 (CCSDS 133.0)."""
    yamcs.write(tmp_path)
    streams = (tmp_path / "etc" / "files.sql").read_text()
    header = bytes.fromhex(streams.split("unhex('")[1].split("'")[0])
    assert len(header) == 15
    assert header[0] >> 5 == 0
    assert header[0] >> 3 & 1 == 1
    assert header[2:6] == b"\xc0\x00\x00\x00"
    assert header[7:] == bytes(8)
