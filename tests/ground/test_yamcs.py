"""Tests of the configuration for Yamcs, and of mission control through the protected link.

`python -m tests.studies.interop.yamcs FOLDER` compares the archive of Yamcs with the flight log.
"""

from __future__ import annotations

import json
import socket
import urllib.error
import urllib.request
from datetime import UTC, datetime
from pathlib import Path

import pytest
import yaml

from flight.app.cli import main as command_line_main
from flight.link.telemetry.definitions import HEALTH
from flight.link.telemetry.packets import LAYOUTS, Packer
from ground.commands.mission_control import Replay
from ground.passes import OrbitPrediction, station_of
from ground.telemetry import read_run
from ground.xtce import SPACE, TELECOMMANDS, spread
from ground.yamcs import (
    INSTANCE,
    RECORDED,
    USER,
    Session,
    add_passes,
    files,
    main,
    password_in,
    procedures_of,
    stacks_and_displays,
    write,
)
from tests.flight.link.telemetry.samples import plain_contents
from tests.support.linked_board import free_ports, write_linked_config
from tests.support.linked_flight import free_port, service
from tests.support.orbit_elements import POLAR_ORBIT
from tests.support.yamcs_server import basic, missing, serving


def test_the_command_writes_the_whole_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["yamcs", str(tmp_path), "--epoch", "2026-11-23T12:00:00"])
    main()
    written = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert written == set(files(tmp_path, "127.0.0.1:1", 1, "2026-11-23T12:00:00"))
    assert {path.stat().st_mode & 0o077 for path in tmp_path.rglob("*") if path.is_file()} == {0}, "passwords"


@pytest.mark.parametrize(
    "name", ["a b", "my: file", "a #b", "{curly}, [square]", 'quoted "x" \\', "häuschen"]
)
def test_any_path_is_a_string_of_the_configuration(tmp_path: Path, name: str) -> None:
    folder = tmp_path / name
    contents = files(folder, None, 1, "2026-11-23T12:00:00", folder / "keys")
    server, instance = (yaml.safe_load(contents[f"etc/yamcs{part}.yaml"]) for part in ("", f".{INSTANCE}"))
    assert (server["dataDir"], server["cacheDir"]) == (str(folder / "data"), str(folder / "data/cache"))
    assert [Path(bucket["path"]).parent for bucket in server["buckets"]] == [folder] * 4
    gateway, recorded = instance["dataLinks"]
    assert Path(gateway["tokenFile"]).parent == folder / "keys"
    assert recorded["incomingDir"] == str(folder / RECORDED)
    assert instance["mdb"][0]["args"]["file"] == str(folder / f"{INSTANCE}.xml")
    assert instance["streamConfig"]["sqlFile"] == str(folder / "etc/files.sql")


def test_stacks_and_displays_name_commands_arguments_and_parameters_of_the_tables() -> None:
    """Every required argument is given, every state is a state of its field, and Yamcs knows every name."""
    fields = {f"/{SPACE}/{name}": field for layout in LAYOUTS.values() for name, field in spread(layout)}
    steps = []
    for name, text in stacks_and_displays().items():
        content = json.loads(text)
        steps += content.get("steps", ())
        assert set(content.get("parameters", ())) <= set(fields), name
    for step in steps:
        if step["type"] == "command":
            packet = TELECOMMANDS[step["name"].removeprefix(f"/{SPACE}/")].packet
            given = [(one["name"], one["value"]) for one in step["arguments"]]
            assert [name for name, _ in given] == [field.name for field in packet.fields]
            pairs = [(field, value) for field, (_, value) in zip(packet.fields, given, strict=True)]
        else:
            pairs = [(fields[one["parameter"]], one["value"]) for one in step["condition"]]
        assert all(not field.states or value in dict(field.states).values() for field, value in pairs), step
    assert {step["type"] for step in steps} == {"command", "verify"}


def test_each_kind_of_body_has_the_command_stacks_that_it_can_obey() -> None:
    shared = {"check-health", "enter-safe", "detumble", "list-files"}
    assert set(procedures_of("testbed")) == {*shared, "leave-safe-to-hold", "slew-to-zero"}
    assert set(procedures_of("orbit")) == {*shared, "leave-safe-to-point"}


def test_a_replay_writes_packets_at_their_mission_time_and_one_file_at_a_time(tmp_path: Path) -> None:
    packets = [Packer().pack(HEALTH, second * 10**9, plain_contents(HEALTH)) for second in (5, 6, 6, 9)]
    (tmp_path / RECORDED).mkdir()
    replay = Replay(packets, tmp_path, 2.0, begun=100.0)

    def read() -> list[bytes]:
        """Read and delete the files in a folder, as Yamcs does."""
        found = sorted((tmp_path / RECORDED).iterdir())
        content = [path.read_bytes() for path in found]
        for path in found:
            path.unlink()
        return content

    replay.turn(100.0)
    replay.turn(100.6)
    assert read() == packets[:1]
    replay.turn(100.6)
    assert read() == [packets[1] + packets[2]]
    replay.turn(101.9)
    assert read() == []
    replay.turn(102.0)
    assert read() == packets[3:]
    at_once = Replay(packets, tmp_path, None, begun=100.0)
    at_once.turn(100.0)
    assert read() == [b"".join(packets)]


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
    """A web page can send text/plain to any loopback port, and Yamcs would read the text as a command."""
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


@pytest.mark.skipif(bool(missing()), reason=missing() or "-")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "has no section `link`"),
        (("--speed", "5"), "--speed: replays a recorded run"),
        (("--recorded", "runs/none"), "runs/none: no flight log"),
    ],
)
def test_mission_control_refuses_what_it_cannot_show(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command_line_main(["mission-control", "step_demo", *words]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(bool(missing()), reason=missing() or "-")
def test_mission_control_operates_a_flight_through_the_client_of_yamcs(tmp_path: Path) -> None:
    """Raise and acknowledge an alarm, run stacks, transfer files, and find a pass on the timeline."""
    from tests.support.yamcs_operator import Operator  # noqa: PLC0415 - imports the client for a second

    (udp,), http = free_ports([socket.SOCK_DGRAM]), free_port()
    flown = tmp_path / "without_camera.yaml"
    flown.write_text("extends: step_demo\ncamera: none\n", encoding="utf-8")
    config = write_linked_config(tmp_path, base=flown, udp=f"127.0.0.1:{udp}", rate=1_000_000)
    out = tmp_path / "out"
    elements = tmp_path / "elements.txt"
    elements.write_text("\n".join(POLAR_ORBIT) + "\n", encoding="utf-8")
    words = [
        "mission-control",
        config,
        "--fly",
        "--keys",
        tmp_path / "keys" / "ground",
        "--out",
        out,
        "--port",
        http,
    ]
    words += ["--elements", elements, "--station", "Berlin,52.5,13.4", "--from", "2026-03-20T12:00:00"]
    begin, station = datetime(2026, 3, 20, 12, tzinfo=UTC), station_of("Berlin,52.5,13.4")
    prediction = OrbitPrediction(POLAR_ORBIT, begin, 1.0)
    with service(tmp_path / "said", "Yamcs on", *words):
        operator = Operator(http, password_in(out))
        operator.wait_for("health_mode", "testbed-demo")
        (run,) = (out / "runs").glob("run-*")
        assert operator.run_stack("leave-safe-to-hold") == "FAILED", "the condition is not met"
        assert operator.run_stack("enter-safe") == "SUCCESSFUL"
        assert operator.raised_and_acknowledged("health_mode") == ("WARNING", True, "seen")
        assert operator.run_stack("leave-safe-to-hold") == "SUCCESSFUL"
        assert operator.sent() == ["safe", "mode"], "no command follows a condition that is not met"
        assert operator.downloaded(f"log/{run.name}/config.yaml") == (run / "config.yaml").read_bytes()
        operator.upload(b"new elements", "elements/new.txt")
        received = tmp_path / "keys" / "files" / "received" / "elements" / "new.txt"
        assert received.read_bytes() == b"new elements"
        passes = operator.passes()
        session = Session(f"http://127.0.0.1:{http}/api", USER, password_in(out))
        add_passes(session, INSTANCE, prediction, [station])
        items = session.ask(f"/timeline/{INSTANCE}/items?limit=500&details=true")["items"]
        assert operator.passes() == passes, "a second prediction replaces the first"
    foreseen = prediction.passes([station])
    assert [start for start, _ in passes] == [one.rise.replace(microsecond=0) for one in foreseen]
    lengths = [(one.set - one.rise).total_seconds() for one in foreseen]
    assert [seconds for _, seconds in passes] == pytest.approx(lengths, abs=1.5)
    for one, item in zip(foreseen, sorted(items, key=lambda item: str(item["start"])), strict=True):
        _, light, sun, *schedule = item["description"].split("; ")
        assert light == f"satellite in {'sunlight' if one.sunlit > 0.5 else 'shadow'}"
        assert sun == f"Sun {one.sun_elevation_deg:.0f} deg high"
        assert [line.split(maxsplit=2)[::2] for line in schedule] == [
            ["schedule", "point ground 52.5deg 13.4deg"],
            ["schedule", "point nadir"],
        ]
    assert "connection closed" not in (tmp_path / "said").read_text(encoding="utf-8")
    words = ["mission-control", config, "--recorded", run, "--out", tmp_path / "replay", "--port", http]
    with service(tmp_path / "replay.log", "Yamcs on", *words):
        replay = Operator(http, password_in(tmp_path / "replay"))
        logged = read_run(run).flight.counts["health"]
        assert replay.archived("health", logged) == logged
