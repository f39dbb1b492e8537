"""Tests that each command line in the documentation works, or that its block says why it is not run."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from flight.app.cli import COMMANDS as FLIGHT_COMMANDS
from ground.commands import COMMANDS as GROUND_COMMANDS
from tests.docs.blocks import ROOT, blocks, blocks_of, pages
from tests.ground.commands.in_process import command
from tests.support.coarse_pictures import draw_coarsely

SHORT = "--duration 1"
RUNNABLE = {block.page for block in blocks() if block.commands and not block.mark}


def shortened(line: str) -> str:
    """Return a quicker command: a short flight with early faults, or a report without plots."""
    if line.startswith("knightcube run ") and "--help" not in line:
        early = re.sub(r"@ \d+", "@ 0.3", re.sub(r" for \d+", " for 0.3", line))
        return re.sub(r" --duration \d+", "", early) + f" {SHORT}"
    if line.startswith("knightcube report") and "--json" not in line:
        return f"{line} --no-figures"
    return line


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the project's files, in which commands may write."""
    folder = tmp_path_factory.mktemp("home")
    for name in ("config", "deploy", "tests"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "docs").mkdir()
    (folder / "docs" / "examples").symlink_to(ROOT / "docs" / "examples")
    run(f"true && knightcube run config/step_demo.yaml --out runs/demo {SHORT}", folder)
    return folder


def run(line: str, folder: Path) -> None:
    """Run a `knightcube` command without shell characters in this process, and other lines in a shell.

    A command that ends in `|| true` may fail.
    """
    plain = line.removesuffix(" || true")
    words = shlex.split(plain)
    if words[0] == "knightcube" and not set(plain) & set("|>&;$*"):
        here = command(*words[1:], folder=folder)
        assert here.returncode == 0 or plain != line, f"{line}\n{here.stderr[-2000:]}"
        return
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": path}
    done = subprocess.run(
        ["bash", "-c", line],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, f"{line}\n{done.stderr[-2000:]}"


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted(RUNNABLE))
def test_the_command_lines_of_a_page_work(page: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command lines of a page succeed in their order on the page.

    The fixture runs the flight of the demonstration once, so the page's command for it is skipped.
    """
    draw_coarsely(monkeypatch)
    for block in blocks():
        if block.page == page and not block.mark:
            for line in block.commands:
                if line != "knightcube run config/step_demo.yaml --out runs/demo":
                    run(shortened(line), home)


def test_every_mark_names_a_test_or_gives_a_reason() -> None:
    for block in blocks():
        where = f"{block.page}:{block.line}"
        if block.mark == "run by":
            text = (ROOT / block.reason).read_text(encoding="utf-8")
            for line in block.commands:
                word = re.match(r"(?:knightcube|python -m (?:flight|sim_hal)) ([a-z][\w-]*)", line)
                runs = word is None or word[1] in text or Path(block.page).name in text
                assert runs, f"{where}: {block.reason} does not run {line!r}"
        elif block.mark:
            assert len(block.reason) > 10, f"{where}: the reason is missing"


def test_commands_in_a_block_without_a_language_are_found() -> None:
    for block in blocks():
        if block.language in {"", "text", "bash", "shell"}:
            assert not re.search(r"^\s*(\$ |python |make |sudo )|^knightcube ", block.text, re.MULTILINE), (
                f"{block.page}:{block.line}: commands belong into a block of `sh`"
            )


def test_the_collector_finds_commands_and_their_marks() -> None:
    """Commands are found in plain blocks and in blocks within lists, without comments, prompts and outputs.

    The mark "not run" before a block in a list is found, together with its reason.
    """
    text = "```sh\nmake a  # why\n# only a remark\nmake b \\\n  c\n```\n\n1. x\n\n"
    text += "    <!-- not run: no need -->\n    ```console\n    $ make d\n    output\n    ```\n"
    first, second = blocks_of(text)
    assert (first.commands, first.mark) == (["make a", "make b    c"], "")
    assert (second.commands, second.mark, second.reason) == (["make d"], "not run", "no need")


def mentions() -> set[tuple[str, str]]:
    """Return (module, first argument) of every command on the pages, in code blocks and in text.

    `knightcube` is the same command as `python -m flight`.
    """
    found = set()
    for path in pages():
        text = re.sub(
            r"(?m)(^ *|`)knightcube (?=[a-z])", r"\1python -m flight ", path.read_text(encoding="utf-8")
        )
        for module, word in re.findall(r"python -m ([\w.]+)(?: ([\w-]+))?", text):
            found.add((module.rstrip("."), word))
    return found


def test_every_module_that_the_pages_call_exists() -> None:
    for module, _ in mentions():
        assert importlib.util.find_spec(module) is not None, module


def test_every_flight_command_that_the_pages_name_exists() -> None:
    known = {**FLIGHT_COMMANDS, **GROUND_COMMANDS}
    for module, word in mentions():
        if module == "flight" and word and not word.startswith("-"):
            assert word in known, word


@pytest.mark.parametrize("study", ["campaigns", "bench"])
def test_every_study_that_the_pages_name_exists(study: str) -> None:
    words = [sys.executable, "-m", f"tests.studies.{study}", "--help"]
    listed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for module, word in mentions():
        if module == f"tests.studies.{study}" and word and word.islower() and not word.startswith("-"):
            assert re.search(rf"\b{re.escape(word)}\b", listed), word
