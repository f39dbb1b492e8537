"""Tests of the subcommands of `knightcube files` over a UDP link: list, get, put, use and delete."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from flight.app.cli import main
from ground.link.terminal import make_keys
from tests.support.flights import CONFIG
from tests.support.flooded_flight import free_port
from tests.support.linked_flight import service

LOG = "log/run-000001/flight-0001.ccsds"


@pytest.fixture(scope="module")
def link_words(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[str]]:
    """Return the command-line arguments for a link whose archive contains a file."""
    place = tmp_path_factory.mktemp("files")
    satellite, ground = make_keys(place / "keys")
    address = f"127.0.0.1:{free_port()}"
    (place / "runs" / "run-000001").mkdir(parents=True)
    (place / "runs" / "run-000001" / "flight-0001.ccsds").write_bytes(bytes(range(256)) * 40)
    commands, link = {"socket": str(place / "commands")}, {"keys": str(satellite), "udp": address}
    config = place / "flight.yaml"
    config.write_text(f"{CONFIG.read_text()}\ncommands: {json.dumps(commands)}\nlink: {json.dumps(link)}\n")
    with service(place / "log", "link open", "link", config, "--log", place / "runs"):
        folder = ["--folder", str(place / "ground"), "--timeout", "30"]
        yield ["files", "--link", address, "--keys", str(ground), *folder]


def test_files_come_down_and_go_up_by_the_command(
    link_words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*link_words, "--json", "get", LOG]) == 0
    (got,) = json.loads(capsys.readouterr().out)["files"]
    assert Path(got["path"]).read_bytes() == bytes(range(256)) * 40
    path = tmp_path / "flight.yaml"
    path.write_text("name: x\n")
    assert main([*link_words, "put", "configuration", str(path)]) == 0
    assert "received/configuration/flight.yaml" in capsys.readouterr().out
    assert main([*link_words, "list"]) == 0
    listed = capsys.readouterr().out
    assert LOG in listed
    assert "8 received/configuration/flight.yaml" in listed
    assert main([*link_words, "use", "configuration", str(path)]) == 0
    assert main([*link_words, "delete", "received/configuration/flight.yaml"]) == 0
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["get", "log/none"], "no such file"),
        (["get", "../keys"], "not an allowed name"),
        (["delete", LOG], "use the name of a received file"),
        (["cancel", "1", "7"], "no transfer 7"),
    ],
)
def test_impossible_requests_are_refused_in_one_line(
    link_words: list[str], words: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*link_words, *words]) == 1
    error = capsys.readouterr().err
    assert reason in error
    assert error.count("\n") == 1


def test_a_second_process_is_refused_and_ctrl_c_says_how_to_continue(
    link_words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        sys.executable,
        "-m",
        "flight",
        *link_words,
        "--rate",
        "2000",
        "put",
        "release",
        str(Path(__file__)),
    ]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "bytes" in process.stderr.readline()
        assert main([*link_words, "list"]) == 2
        assert "another process" in capsys.readouterr().err
        process.send_signal(2)
        assert "run the same command again" in process.stderr.read()
    assert process.returncode == 1


def test_wrong_values_are_refused(link_words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*link_words, "--rate", "0", "list"]) == 2
    for word in ("put", "use"):
        assert main([*link_words, word, "configuration", "/none"]) == 2
        assert f"/none: no such file on the ground: `files {word}`" in capsys.readouterr().err
