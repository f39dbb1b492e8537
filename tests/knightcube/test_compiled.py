"""Functions with a compiled form: which form runs, and that numba's installation is optional."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.compiled import HotFunction, compiled_form_of, in_use, loop_helper
from tests.support.compiled_forms import assert_forms_agree


def _sum_of_squares_numpy(values: FloatArray) -> float:
    return float(values @ values)


@loop_helper
def _square(value: float) -> float:
    return value * value


@compiled_form_of(_sum_of_squares_numpy)
def _sum_of_squares(values: FloatArray) -> float:
    total = 0.0
    for value in values:
        total += _square(value)
    return total


VALUES = np.linspace(-1.0, 2.0, 1_000)


def test_all_forms_return_the_same() -> None:
    assert_forms_agree(_sum_of_squares, VALUES)
    assert _sum_of_squares.numpy_form(VALUES) == pytest.approx(1001.5015015015, rel=1e-9)


def test_the_variable_selects_the_numpy_form(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KNIGHTCUBE_COMPILED", "0")
    assert not in_use()

    @compiled_form_of(_sum_of_squares_numpy)
    def fails(values: FloatArray) -> float:
        raise AssertionError(f"called with {values.size} values")

    assert fails(VALUES) == _sum_of_squares_numpy(VALUES)


def test_without_numba_the_numpy_form_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KNIGHTCUBE_COMPILED", raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    assert not in_use()


def test_a_numba_that_cannot_be_imported_is_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Numba refuses to be imported beside a numpy that is too new for it."""
    (tmp_path / "numba.py").write_text("raise ImportError('Numba needs NumPy 2.4 or less')", encoding="utf-8")
    code = (
        "import numpy as np\nfrom knightcube.vision.frame import estimate_background\n"
        "estimate_background(np.zeros((64, 64)))"
    )
    environment = {**os.environ, "KNIGHTCUBE_COMPILED": "1", "PYTHONPATH": f"{tmp_path}:{os.getcwd()}"}
    subprocess.run([sys.executable, "-c", code], env=environment, timeout=100, check=True)


@pytest.mark.parametrize("dtype", [">f8", "f2"])
def test_arrays_that_numba_does_not_know_are_left_to_numpy(
    dtype: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("numba", reason="numba is not installed: pip install knightcube[fast]")
    monkeypatch.setenv("KNIGHTCUBE_COMPILED", "1")
    hot = HotFunction(_sum_of_squares_numpy, _sum_of_squares.loop_form)
    values = VALUES.astype(dtype)
    assert hot(values) == pytest.approx(_sum_of_squares_numpy(values))
    assert hot(VALUES) == pytest.approx(_sum_of_squares_numpy(VALUES))


@pytest.mark.parametrize("module", ["knightcube", "flight.__main__", "knightcube.vision.star_tracker"])
def test_an_import_does_not_load_numba(module: str) -> None:
    """Numba takes a third of a second and 100 MB, which a command that finds no stars should not pay."""
    code = f"import sys, {module}; sys.exit('numba' in sys.modules)"
    subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "KNIGHTCUBE_COMPILED": "1"}, timeout=100, check=True
    )
