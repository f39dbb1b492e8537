"""Functions with a compiled form: which form runs, and that numba's installation is optional."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.compiled import compiled_form_of, in_use, loop_helper
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


@pytest.mark.parametrize("module", ["knightcube", "flight.__main__", "knightcube.vision.star_tracker"])
def test_an_import_does_not_load_numba(module: str) -> None:
    """Numba takes a third of a second and 100 MB, which a command that finds no stars should not pay."""
    code = f"import sys, {module}; sys.exit('numba' in sys.modules)"
    subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "KNIGHTCUBE_COMPILED": "1"}, timeout=100, check=True
    )
