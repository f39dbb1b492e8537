"""Tests of the commands of studies and benches: lists, arguments and wrong use."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Annotated, Literal

import pytest

from knightcube.errors import UsageError
from tests.studies.bench import __main__ as bench
from tests.studies.campaigns import CAMPAIGNS, campaign
from tests.studies.command import command

ROOT = Path(__file__).resolve().parents[3]


def _run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tests.studies", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", ["campaigns", "bench", "same_bytes", "house", "mutants"])
def test_a_study_gets_the_rest_of_the_line(name: str) -> None:
    done = _run(name, "--help")
    assert done.returncode == 0
    assert "usage:" in done.stdout


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_every_listed_campaign_has_its_functions(name: str) -> None:
    found = campaign(name)
    assert (found.name, found.default_runs) == (name, CAMPAIGNS[name].runs)
    assert [callable(function) for function in (found.cases, found.run, found.summarise)] == 3 * [True]


def test_help_lists_the_studies() -> None:
    done = _run("--help")
    assert done.returncode == 0
    assert "usage: python -m tests.studies NAME" in done.stdout
    assert "campaigns" in done.stdout


def test_an_unknown_study_is_wrong_use_and_the_known_ones_are_listed() -> None:
    done = _run("nosuch")
    assert done.returncode == 2
    assert "there is no study 'nosuch'" in done.stderr
    assert "campaigns" in done.stderr
    assert "checks" not in done.stderr


def test_every_bench_is_listed_with_one_line_and_none_is_imported(capsys: pytest.CaptureFixture[str]) -> None:
    before = set(sys.modules)
    assert bench.main([]) == 0
    listed = capsys.readouterr().out
    for name, line in bench.benches().items():
        assert f"  {name}" in listed
        assert line in listed
        assert line
    assert {"executive", "starid", "likelihood", "plan"} <= bench.benches().keys()
    assert not {name for name in set(sys.modules) - before if name.startswith("tests.studies.bench.")}


def test_an_unknown_bench_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        bench.main(["nothing"])
    assert stopped.value.code == 2
    assert "likelihood" in capsys.readouterr().err


def test_a_bench_gets_its_own_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        bench.main(["plan", "--help"])
    assert stopped.value.code == 0
    assert "usage: python -m tests.studies.bench plan" in capsys.readouterr().out


given: list[object] = []


@command
def study(
    name: Annotated[str, "an argument"] = "none",
    *,
    time: Annotated[float | None, "s"] = None,
    sizes: Annotated[tuple[int, ...], "50 %"] = (1, 2),
    kind: Annotated[Literal["one", "two"], "of two"] = "one",
    quick: Annotated[bool, "without waiting"] = False,
) -> int:
    if quick and time:
        raise UsageError("--time: not with --quick")
    given[:] = [name, time, list(sizes), kind, quick]
    return 3


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("", ["none", None, [1, 2], "one", False]),
        ("a --time 2 --sizes 3 4 --kind two", ["a", 2.0, [3, 4], "two", False]),
        ("--quick", ["none", None, [1, 2], "one", True]),
    ],
)
def test_the_options_of_a_command_are_the_parameters_of_its_function(
    words: str, expected: list[object]
) -> None:
    assert study(words.split()) == 3
    assert given == expected


@pytest.mark.parametrize("words", ["--kind three", "--sizes x", "a b"])
def test_a_wrong_option_ends_a_command_with_status_2(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        study(words.split())
    assert stopped.value.code == 2
    assert "error: " in capsys.readouterr().err


def test_a_usage_error_is_printed_in_one_line_and_the_status_is_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert study(["--quick", "--time", "1"]) == 2
    assert capsys.readouterr().err == "test_studies: --time: not with --quick\n"
