"""Comparison of three implementations of a function: in numpy, as loops, and as loops compiled by numba.

Compilation takes seconds. In runs without slow tests, `tests/conftest.py` sets `compiles` to False; then only
the first two implementations are compared.
"""

from __future__ import annotations

import copy
import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.compiled import HotFunction, compiled_form_of, loop_helper

compiles = True
"""Whether compiled implementations are also compared."""
compiling_s = 0.0
"""Processor time (s) that the compiled implementations have taken in this process."""


def sum_of_squares_numpy(values: FloatArray) -> float:
    """Return the sum of the squares of values."""
    return float(values @ values)


@loop_helper
def _square(value: float) -> float:
    return value * value


@compiled_form_of(sum_of_squares_numpy)
def sum_of_squares(values: FloatArray) -> float:
    """Return the sum of the squares of values, as a minimal example of a function that can be compiled."""
    total = 0.0
    for value in values:
        total += _square(value)
    return total


def assert_forms_agree(
    hot: HotFunction[Any, Any],
    *args: Any,
    relative: float = 1e-9,
    interpreted: bool = True,
    compiled: bool = True,
) -> None:
    """Call all implementations of a function with copies of the arguments, and compare the results.

    Arguments that the function changes are compared too.

    Array values must agree within `relative` times the value or the array's largest value. If `interpreted`
    is set, the implementation with loops is also called without compilation, because Python checks every
    index and compiled code does not. If `compiled` is set, the compiled implementation is called too, except
    in runs without slow tests.
    """
    expected = _called(hot.numpy_form, args)
    for found in (
        *([_called(hot.loop_form, args)] if interpreted else []),
        *([_compiled(hot, args)] if compiled and compiles else []),
    ):
        assert len(found) == len(expected)
        for one, other in zip(expected, found, strict=True):
            first, second = np.asarray(one), np.asarray(other)
            assert first.dtype.kind == second.dtype.kind
            scale = np.abs(first[np.isfinite(first)]).max(initial=0.0)
            np.testing.assert_allclose(second, first, rtol=relative, atol=relative * float(scale))


def _compiled(hot: HotFunction[Any, Any], args: tuple[Any, ...]) -> list[Any]:
    """Return the results of the compiled implementation, and add the processor time to `compiling_s`."""
    global compiling_s  # noqa: PLW0603
    import pytest  # noqa: PLC0415 - the programs that `test_compiled.py` starts do not need it

    pytest.importorskip("numba", reason="numba is not installed: pip install knightcube[fast]")
    begun = time.process_time()
    results = _called(_compiled_form(hot), args)
    compiling_s += time.process_time() - begun
    return results


@functools.cache
def _compiled_form(hot: HotFunction[Any, Any]) -> Callable[..., Any]:
    """Return the compiled implementation, which all tests of this process share."""
    return hot.compiled_form()


def _called(form: Any, args: tuple[Any, ...]) -> list[Any]:
    """Return the results of one implementation, and its array arguments after the call."""
    own = [_copied(each) for each in args]
    result = form(*own)
    results = list(result) if isinstance(result, tuple) else [] if result is None else [result]
    return results + [each for each in own if isinstance(each, np.ndarray)]


def _copied(value: Any) -> Any:
    """Return a deep copy of an argument. The copy of a read-only array is read-only.

    If a function receives read-only and writable arrays, numba compiles it twice.
    """
    own = copy.deepcopy(value)
    if isinstance(own, np.ndarray):
        own.flags.writeable = value.flags.writeable
    return own
