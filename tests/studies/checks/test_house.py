"""Tests of the sizes of files, classes and functions, and of the files that an activity uses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from knightcube.astro import quaternion
from tests.studies.house import LIMITS, Touched, kept, main, measure, pieces


def test_long_functions_and_classes_are_found_unless_a_class_gives_its_reason(tmp_path: Path) -> None:
    body = "\n".join(f"        x = {i}" for i in range(55))
    wide = "\n".join(f"    a{i} = {i}" for i in range(360))
    reason = '    """Over 350 lines: a table."""\n'
    (tmp_path / "hal").mkdir()
    text = f"class A:\n    def long(self):\n{body}\nclass B:\n{wide}\nclass C:\n{reason}{wide}\n"
    (tmp_path / "hal" / "long.py").write_text(text, encoding="utf-8")
    measured = pieces(tmp_path)
    assert (measured[0].name, measured[0].lines) == ("hal/long.py", text.count("\n"))
    assert [piece.name for piece in measured if piece.long] == ["hal/long.py:B", "hal/long.py:A:long"]
    assert not kept([piece for piece in measured if piece.long])


def test_files_classes_and_functions_keep_their_sizes() -> None:
    long = [piece for piece in pieces() if piece.long]
    assert kept(long), "\n".join(map(str, long))


def test_the_command_prints_one_object_and_its_status_says_whether_all_limits_are_met(
    capsys: pytest.CaptureFixture[str],
) -> None:
    status = main(["--json"])
    printed = json.loads(capsys.readouterr().out)
    assert status == int(any(piece["kind"] != "function" for piece in printed["long"]))
    assert printed["lines"] > 0


def test_a_cycle_an_opening_and_a_star_fix_enter_few_files() -> None:
    entered = measure()
    assert "flight/loop/flight_loop.py" in entered["control cycle"]
    assert "flight/app/flight.py" in entered["opening of a flight"]
    assert "knightcube/vision/star_tracker.py" in entered["star fix"]
    assert {name: len(files) for name, files in entered.items() if len(files) > LIMITS[name]} == {}


def test_a_called_function_counts_and_a_function_that_is_not_called_does_not() -> None:
    touched = Touched()
    with touched.measured():
        pass
    assert touched.files == set()
    with touched.measured():
        quaternion.conjugate(np.array([0.0, 0.0, 0.0, 1.0]))
    assert touched.files == {"knightcube/astro/quaternion.py"}
