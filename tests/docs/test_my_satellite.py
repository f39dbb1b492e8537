"""Tests of the page "My satellite": its code blocks are valid and its commands run."""

from __future__ import annotations

import json
import math
import re
import shlex
from pathlib import Path

import pytest

from flight.schema.bodies import as_orbit
from flight.schema.reader import load, parse
from tests.docs.blocks import blocks
from tests.ground.commands.in_process import command
from tests.support.places import ROOT

PAGE = ROOT / "docs" / "fly" / "my-satellite.md"


def block(start: str) -> str:
    """Return the code block of the page that begins with a text."""
    text = PAGE.read_text(encoding="utf-8")
    return start + text.split(f"\n{start}", 1)[1].split("\n```", 1)[0]


def test_the_extended_configuration_has_the_described_values(tmp_path: Path) -> None:
    base = as_orbit(load(ROOT / "config" / "orbit_3u.yaml"))
    own = as_orbit(parse(block("extends:"), str(tmp_path / "mine.yaml")))
    assert (own.name, own.coils.current_limit, own.coils.resistance) == (
        "my_satellite",
        0.12,
        base.coils.resistance,
    )
    assert [step.point for step in own.targets] == ["sun"]
    assert own.wide_cameras == base.wide_cameras


def test_the_described_coils_are_flown(tmp_path: Path) -> None:
    text = "extends: orbit.yaml\nname: rods\n" + block("coils:\n  supply_voltage: 5.0")
    coils = as_orbit(parse(text, str(tmp_path / "rods.yaml"))).coils
    assert coils.channels == ((0, 1), (2, 3), (4, 5))
    assert coils.limits == (0.1, 0.1, 0.08)
    assert coils.map().limits.min() > 0.1


def test_the_commands_of_two_line_elements_print_the_same_section() -> None:
    lines = block("knightcube elements").splitlines()
    assert len(lines) == 2
    first, second = (command(*line.split()[1:]) for line in lines)
    assert (first.returncode, second.returncode) == (0, 0), first.stderr + second.stderr
    assert first.stdout == second.stdout
    assert first.stdout.startswith("elements: ")


def test_the_example_prints_what_the_page_shows(tmp_path: Path) -> None:
    (line,) = next(
        one.commands
        for one in blocks()
        if one.page == "docs/fly/my-satellite.md" and "new-satellite" in one.text and one.commands
    )
    done = command(*shlex.split(line)[1:], folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.rstrip() == block("written:    heron.yaml")


def newcomer() -> tuple[list[str], list[str]]:
    """Return the commands of the tutorial that install the software and simulate the reader's satellite."""
    install, fly = (
        next(one.commands for one in blocks() if one.page == "docs/tutorial.md" and word in one.text)
        for word in ("git clone", "new-satellite")
    )
    return install, fly


def test_a_newcomer_needs_at_most_ten_commands() -> None:
    install, fly = newcomer()
    assert len(install) + len(fly) <= 10
    assert [line.split()[1] for line in fly] == ["new-satellite", "check", "run", "report"]


@pytest.mark.slow
def test_the_commands_of_a_newcomer_describe_and_detumble_a_satellite(tmp_path: Path) -> None:
    """The satellite of the tutorial is detumbled after 106 s.

    The test shortens its flight from 150 s to 112 s.
    """
    _, (new, check, run, judge) = newcomer()
    assert "--duration 150" in run
    for line in (new, check, run.replace("150", "112"), f"{judge} --json --no-figures"):
        done = command(*shlex.split(line)[1:], folder=tmp_path)
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
    (phase,) = json.loads(done.stdout)["detumbling"]["periods"]
    assert phase["slowed"]
    page = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    stated, last = map(float, re.findall(r"detumbling: ([\d.]+) s, from 5.0 to ([\d.]+) deg/s", page)[0])
    assert phase["duration_s"] == pytest.approx(stated, rel=0.05)
    assert math.degrees(phase["last_rate_rad_s"]) == pytest.approx(last, abs=0.05)
