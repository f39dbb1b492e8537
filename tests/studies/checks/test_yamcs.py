"""Yamcs, a ground station of other authors, follows and commands a flight through the protected link.

`python -m tests.studies.interop.yamcs FOLDER` flies the commands that need minutes.
"""

from __future__ import annotations

import json
import socket
import time
import urllib.error
import urllib.request
from contextlib import ExitStack
from pathlib import Path

import pytest

from ground.xtce import SPACE
from ground.yamcs import INSTANCE, USER, files, main, write
from tests.flight.app.cli.linked_board import free_ports, write_linked_config
from tests.studies.interop.yamcs import PLANS, fly
from tests.support.linked_flight import free_port, service
from tests.support.yamcs_server import Yamcs, basic, credentials, missing, serving


def test_the_command_writes_the_whole_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["yamcs", str(tmp_path), "--epoch", "2026-11-23T12:00:00"])
    main()
    written = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert written == set(files(tmp_path, "127.0.0.1:1", 1, "2026-11-23T12:00:00"))
    assert {path.stat().st_mode & 0o077 for path in tmp_path.rglob("*") if path.is_file()} == {0}, "passwords"


@pytest.mark.parametrize(("frame_bytes", "unit_bytes"), [(1024, 900), (300, 246), (128, 74)])
def test_file_data_fit_into_the_configured_telecommand_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, frame_bytes: int, unit_bytes: int
) -> None:
    monkeypatch.setattr("sys.argv", ["yamcs", str(tmp_path), "--command-frame-bytes", str(frame_bytes)])
    main()
    text = (tmp_path / "etc" / f"yamcs.{INSTANCE}.yaml").read_text(encoding="utf-8")
    assert f"maxPduSize: {unit_bytes}\n" in text
    assert 7 + 30 + 6 + 9 + 2 + unit_bytes <= frame_bytes, "headers, security and CRCs around the unit"


@pytest.mark.slow
@pytest.mark.skipif(bool(missing()), reason=missing() or "-")
def test_yamcs_does_not_obey_a_web_page_that_has_no_password(tmp_path: Path) -> None:
    """A browser sends a page's text/plain to any port of loopback; Yamcs reads it as a command."""
    http = free_port()
    write(tmp_path, f"127.0.0.1:{free_port()}", http)
    with serving(tmp_path, http) as server:
        url = f"{server.url}/processors/{INSTANCE}/realtime/commands/{SPACE}/ping"
        found = []
        for credentials in ({}, {"Authorization": basic(USER)}, {"Authorization": server.credentials}):
            headers = {"Content-Type": "text/plain", "Origin": "http://evil.example", **credentials}
            request = urllib.request.Request(url, b'{"args": {"number": "3"}}', headers)
            opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
            try:
                with opener.open(request, timeout=60.0) as answer:
                    found.append(answer.status)
            except urllib.error.HTTPError as error:
                error.close()
                found.append(error.code)
    assert found == [401, 401, 200]


@pytest.mark.slow
@pytest.mark.skipif(bool(missing()), reason=missing() or "-")
def test_mission_control_commands_the_satellite_of_a_configuration(tmp_path: Path) -> None:
    (udp,), http = free_ports([socket.SOCK_DGRAM]), free_port()
    config, out = write_linked_config(tmp_path, udp=f"127.0.0.1:{udp}"), tmp_path / "out"
    words = ["mission-control", config, "--keys", tmp_path / "keys" / "ground", "--out", out, "--port", http]
    with ExitStack() as stack:
        link = ("link", config, "--log", tmp_path / "runs")
        stack.enter_context(service(tmp_path / "link.log", "link open", *link))
        process = stack.enter_context(service(tmp_path / "said", "Yamcs on", *words))
        server = Yamcs(f"http://127.0.0.1:{http}/api", process, out / "log", credentials(out))
        server.wait()
        until = time.monotonic() + 60.0
        while not server.link_up() and time.monotonic() < until:
            time.sleep(0.2)
        identifier = server.command("list-schedule", {})
        while "CommandComplete_Status" not in (history := server.history(identifier)):
            assert time.monotonic() < until + 60.0, history
            time.sleep(0.2)
    assert history["CommandComplete_Status"] == "OK"
    assert "connection closed" not in (tmp_path / "said").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.skipif(bool(missing()), reason=missing() or "-")
def test_yamcs_archives_and_commands_a_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every packet and value is ours, every command completed, no warning, no socket beyond loopback."""
    sound = fly(tmp_path, PLANS["short"])
    said = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert sound, said
    assert len(said) == 5
