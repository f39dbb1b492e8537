"""Runs the commands of the page "A day of operations" in order against a simulated satellite."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.docs.blocks import blocks
from tests.ground.commands.in_process import command
from tests.support.flooded_flight import free_port
from tests.support.places import ROOT

PAGE = "docs/fly/day-of-operations.md"
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": str(ROOT),
    "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
}
READY_S = 100.0
BLIND = "camera: null\nwide_cameras: []\n"
"""Settings without cameras. No command of the page uses a camera, and a flight without cameras is faster."""
FIXES_S = 20.0
"""Mission time (s) from which the log has enough GPS fixes to determine orbital elements.

A reader of the page types the command that needs the fixes later than 20 s after the start.
"""


@contextlib.contextmanager
def in_background(line: str, folder: Path, is_ready: Callable[[Path], bool]) -> Iterator[None]:
    """Run a command in the background until the context ends.

    The context begins when `is_ready` accepts the output.
    """
    log = folder / f"{line.split()[1]}.log"
    with (
        log.open("wb") as file,
        subprocess.Popen(
            line.split(), cwd=folder, env=ENVIRONMENT, stdout=file, stderr=subprocess.STDOUT
        ) as process,
    ):
        try:
            until = time.monotonic() + READY_S
            while not is_ready(log):
                assert process.poll() is None, log.read_text(encoding="utf-8")
                assert time.monotonic() < until, log.read_text(encoding="utf-8")
                time.sleep(0.1)
            yield
        finally:
            process.terminate()


def run(line: str, folder: Path, satellite: str) -> str:
    """Return the output of a ground command. Most commands run in this process, to save time."""
    words = shlex.split(line.replace("$SATELLITE", satellite))
    if words[0] == "knightcube" and not {"|", ">"} & set(words):
        done = command(*words[1:], folder=folder)
    else:
        done = subprocess.run(
            ["bash", "-c", line],
            cwd=folder,
            env={**ENVIRONMENT, "SATELLITE": satellite},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
    assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
    return done.stdout


@pytest.mark.slow
def test_the_commands_of_the_page_operate_a_simulated_satellite(tmp_path: Path) -> None:
    first, link, export, *ground = [
        block.commands
        for block in blocks()
        if block.page == PAGE and block.commands and block.mark == "run by"
    ]
    keys, copy, fly = first
    port = free_port()
    satellite = export[0].partition("=")[2].strip('"').replace("5010", str(port))
    run(keys, tmp_path, satellite)
    run(copy.replace("~/knightcube", str(ROOT)), tmp_path, satellite)
    practice = tmp_path / "practice.yaml"
    text = practice.read_text(encoding="utf-8").replace("5010", str(port))
    practice.write_text(f"{text}{BLIND}", encoding="utf-8")
    with (
        in_background(fly, tmp_path, lambda _: (tmp_path / "practice.socket").exists()),
        in_background(link[0], tmp_path, lambda log: "link open on" in log.read_text(encoding="utf-8")),
    ):
        until = time.monotonic() + READY_S
        state = "knightcube watch $SATELLITE --json"
        while json.loads(run(state, tmp_path, satellite))["mission_time_s"] < FIXES_S:
            assert time.monotonic() < until
            time.sleep(2.0)
        printed = [(line, run(line, tmp_path, satellite)) for lines in ground for line in lines]

    def after(words: str) -> list[str]:
        return [text for line, text in printed if words in line]

    assert ["completed: ping" in text for text in after("ping")] == [True]
    assert "started: mode point" in after("mode point")[0]
    # The words of a line are mission time, its unit, UTC if it was received, and mode.
    lines = [[word for word in text.split() if not word.endswith("Z")] for text in after("watch")]
    before, in_safe, at_the_end = (words[2] for words in lines)
    assert before != "safe"
    assert in_safe == "safe"
    assert at_the_end != "safe"
    assert "2026-03-20T13:30:00Z point ground" in after("list-schedule")[0]
    assert "Berlin" in after("passes")[0]
