"""Tests that no command prints control characters from data, because they could control the terminal."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from flight.link.telemetry.log import find_segments
from flight.link.telemetry.packets import CRC_BYTES, crc16, walk
from tests.ground.commands.in_process import command
from tests.ground.report.synthetic import Recipe, make_run

ATTACK = b"\x1b]0;x\x07\x9b2J\r\x08"
CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
"""Control characters except tab and line feed."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run whose texts in the log all begin with control characters."""
    folder = make_run(
        tmp_path_factory.mktemp("runs") / "run-000001", Recipe(duration=40.0, rate_hz=10.0, hold=10.0)
    )
    changed = 0
    for path in find_segments(folder, "flight"):
        data = bytearray(path.read_bytes())
        for layout, begin, end in list(walk(bytes(data))):
            packet = bytearray(data[begin:end])
            row = np.frombuffer(packet, layout.dtype)
            for field in layout.packet.fields:
                if field.kind.startswith("S") and row[field.name].ndim == 1:
                    row[field.name] = ATTACK + row[field.name][0]
                    changed += 1
            body = bytes(packet[:-CRC_BYTES])
            data[begin:end] = body + crc16(body).to_bytes(CRC_BYTES, "big")
        path.write_bytes(data)
    assert changed > 5
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ("report", "RUN"),
        ("report", "RUN", "RUN"),
        ("report", "RUN", "--json"),
        ("watch", "RUN", "--once"),
        ("watch", "RUN", "--once", "--json"),
        ("watch", "RUN", "--plain", "--patience", "0.1"),
        ("runs", "RUNS"),
        ("orbit", "RUN"),
        ("identify", "RUN"),
        ("export", "RUN", "OUT"),
    ],
    ids=" ".join,
)
def test_texts_of_a_log_do_not_control_the_terminal(
    run: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    places = {"RUN": run, "RUNS": run.parent, "OUT": tmp_path / "out"}
    done = command(*(places.get(word, word) for word in words))
    assert done.stdout + done.stderr != ""
    assert CONTROL.findall(done.stdout) == []
    assert CONTROL.findall(done.stderr) == []
    if words[:2] == ("report", "RUN") and len(words) == 2:
        assert "\\x1b]0;x\\x07" in done.stdout, "the texts are shown"
    if words[-1] == "--json":
        json.loads(done.stdout)


@pytest.mark.parametrize(
    ("text", "status"),
    [
        ('name: "\\e[2J"\n', 2),
        ('name: x\n"\\e[2J": 1\n', 2),
        ('body: "\\e[2J:y"\nextends: step_demo\n', 2),
        ('extends: step_demo\nguidance: {cost: "\\e[2J\\a"}\n', 2),
        ('name: x\nextends: "\\e[2J.yaml"\n', 2),
    ],
)
def test_a_configuration_does_not_control_the_terminal(tmp_path: Path, text: str, status: int) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(text, encoding="utf-8")
    done = command("check", path)
    assert (done.returncode, CONTROL.findall(done.stdout + done.stderr)) == (status, [])


def test_a_file_name_does_not_control_the_terminal(tmp_path: Path) -> None:
    for word in ("report", "watch", "check", "export", "rate", "solve"):
        done = command(word, tmp_path / "\x1b[2J\r")
        assert done.returncode != 0
        assert CONTROL.findall(done.stdout + done.stderr) == []
