"""Compiled forms of frequently executed functions, which numba generates if it is installed.

A function with a compiled form has a numpy form and a loop form, which return the same values up to rounding.
The numpy form is the reference, and also works without numba. The loop form is plain Python with loops over
elements, which numba compiles at its first call. The decorator `@compiled_form_of(numpy_form)` combines the
loop form with the numpy form:

    @compiled_form_of(sum_of_squares_numpy)
    def sum_of_squares(values: FloatArray) -> float:
        total = 0.0
        for value in values:
            total += value * value
        return total

`pip install knightcube[fast]` installs numba. The environment variable KNIGHTCUBE_COMPILED=0 selects the
numpy forms even if numba is installed. The function `use_numpy_forms` also selects the numpy forms; the
control loop calls it in a real-time flight, because the first call of a compiled form takes some seconds.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import logging
import os
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, ParamSpec, TypeVar

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

_SWITCH = "KNIGHTCUBE_COMPILED"
_ANY_ORDER = {"reassoc", "contract", "nsz"}
"""LLVM options for functions that loop forms call: sums in any order, which permits vector instructions."""
_UNWRAPPED = {"error_model": "numpy", "no_cfunc_wrapper": True}
"""Options of numba: numpy's rules for division by zero, and no C wrapper, which no caller needs.
"""
_COMPILING = (
    "numba compiles the functions in use for this machine; this takes one to three minutes, once "
    f"({_SWITCH}=0 avoids it)"
)
_functions: list[HotFunction[Any, Any]] = []
"""All functions of this process that have a compiled form."""
_helpers: list[Callable[..., Any]] = []
"""Functions decorated by `loop_helper` that are not yet registered for compilation by numba."""


class HotFunction(Generic[Parameters, Result]):
    """Function with a numpy form and a loop form; each process uses one of the two forms."""

    def __init__(
        self, numpy_form: Callable[Parameters, Result], loop_form: Callable[Parameters, Result]
    ) -> None:
        functools.update_wrapper(self, loop_form)
        self.numpy_form = numpy_form
        self.loop_form = loop_form
        self._chosen: Callable[Parameters, Result] | None = None
        self._refusals: tuple[type[Exception], ...] = ()
        _functions.append(self)

    def __call__(self, *args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        """Return the result of the compiled form, or of the numpy form if compiled forms are switched off.

        The numpy form is also used for argument types that numba does not support, such as big-endian arrays,
        and if the cache file of the compiled form is damaged or cannot be written.
        """
        chosen = self._chosen or self._choose()
        try:
            return chosen(*args, **kwargs)
        except self._refusals:  # these exceptions are raised before the compiled form runs
            return self.numpy_form(*args, **kwargs)

    def _choose(self) -> Callable[Parameters, Result]:
        self._chosen = self.numpy_form
        if in_use():
            self._chosen = self.compiled_form()
            unknown = importlib.import_module("numba.core.errors").NumbaError
            self._refusals = (unknown, NotImplementedError, OSError, EOFError, pickle.UnpicklingError)
        return self._chosen

    def load(self) -> None:
        """Load the machine code that earlier processes stored; otherwise the first call would load it."""
        form: Any = self._chosen or self._choose()
        with contextlib.suppress(AttributeError, *self._refusals):  # the first call then loads or compiles
            cache, codegen = form._cache, form.targetctx.codegen()
            for key in cache._cache_file._load_index():
                if key == cache._index_key(key[0], codegen):
                    form.compile(key[0])

    def compiled_form(self) -> Callable[Parameters, Result]:
        """Return the loop form as a function that numba compiles and, if possible, stores in a file.

        Raises ImportError if numba is not installed, or does not support the installed numpy version.
        """
        numba = importlib.import_module("numba")
        _announce_compilation()
        # Helpers are inlined, because otherwise the process that compiles a helper and the processes that
        # load the helper from the cache file would use different machine code, which computes sums in
        # different orders.
        options = {**_UNWRAPPED, "no_cpython_wrapper": True, "fastmath": _ANY_ORDER, "forceinline": True}
        while _helpers:
            numba.extending.register_jitable(**options)(_helpers.pop())
        try:
            return _typed(numba.njit(cache=True, **_UNWRAPPED)(self.loop_form))
        except RuntimeError:  # no cache folder is writable
            return _typed(numba.njit(**_UNWRAPPED)(self.loop_form))


def compiled_form_of(
    numpy_form: Callable[Parameters, Result],
) -> Callable[[Callable[Parameters, Result]], HotFunction[Parameters, Result]]:
    """Return the decorator that combines a loop form with its numpy form.

    The loop form has only positional arguments, which are arrays, numbers and tuples of numbers. The loop
    form may call only numpy functions that numba supports, functions of the same module that `loop_helper`
    decorates, and the quaternion algebra of `knightcube.astro.quaternion`. The loop form must not use
    constants or functions of other modules: numba compiles a cached function again only if the function's own
    module changes, so the cached function would keep an outdated constant. The quaternion algebra is exempt
    because its formulas do not change.
    """
    return lambda loop_form: HotFunction(numpy_form, loop_form)


def compiled_floats(function: Callable[Parameters, Result]) -> HotFunction[Parameters, Result]:
    """Return a function of floats and tuples of floats that is both its numpy form and its loop form.

    A compiled call with ten tuples takes 1 us, so that a step with a hundred operations is twenty times as
    fast as in plain Python. The rules of `compiled_form_of` apply to the function.
    """
    return HotFunction(function, function)


@compiled_floats
def _nothing(_: Any) -> None:
    """Do nothing. The first call of this function loads numba and the modules that numba needs for arrays."""


def load(*packages: str) -> None:
    """Load numba, and the stored compiled forms of the functions of `packages`, if compiled forms are in use.

    Otherwise, the first call of each function would load its compiled form, which takes some milliseconds,
    and the very first call would also load numba, which takes half a second.
    """
    _nothing(importlib.import_module("numpy").zeros(1))
    for function in _functions if in_use() else ():
        if function.__module__.startswith(packages):
            function.load()


def loop_helper(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Return `function` unchanged, after marking it for compilation with the loop forms that call it.

    A loop form is a function with plain Python loops that numba compiles, and may call marked functions. The
    compiled form of a marked function may compute sums in any order.
    """
    _helpers.append(function)
    return function


def in_use() -> bool:
    """Return whether functions that this process has not called yet will use their compiled forms."""
    return os.environ.get(_SWITCH, "1") != "0" and _numba_is_usable()


@functools.cache
def _numba_is_usable() -> bool:
    """Import numba, and return whether it is installed and supports the installed numpy version."""
    try:
        importlib.import_module("numba")
    except ImportError:
        return False
    return True


@dataclass(slots=True)
class _Compilation:
    """Compilations in this process: total time (ns), nesting depth, start (ns), and callback for names."""

    spent_ns: int = 0
    depth: int = 0
    begun_ns: int = 0
    report: Callable[[str], None] | None = None


_compilation = _Compilation()


def compilation_ns() -> int:
    """Return the time (ns) that this process has spent on compiling, which excludes loading machine code.

    The function is for measurements of execution times, which must not contain the compilation.
    """
    return _compilation.spent_ns


def report_compilations(report: Callable[[str], None] | None) -> None:
    """Call `report` with the name of each function that numba begins to compile; None ends the reports."""
    _compilation.report = report


@functools.cache
def _announce_compilation() -> None:
    """Measure and report compilations but not cache loads, and log a warning before the first compilation."""
    event = importlib.import_module("numba.core.event")

    class Compilations(event.Listener):  # type: ignore[misc, name-defined]  # numba has no types
        def on_start(self, happened: Any) -> None:
            if not _compilation.spent_ns and not _compilation.depth:
                logging.getLogger(__name__).warning(_COMPILING)
            _compilation.depth += 1
            if _compilation.depth > 1:  # a function that the compiled function calls
                return
            _compilation.begun_ns = time.perf_counter_ns()
            if _compilation.report is not None:
                _compilation.report(str(happened.data["dispatcher"].__name__))

        def on_end(self, _: object) -> None:
            _compilation.depth -= 1
            if not _compilation.depth:
                _compilation.spent_ns += time.perf_counter_ns() - _compilation.begun_ns

    event.register("numba:compile", Compilations())


def use_numpy_forms() -> None:
    """Make this process and its child processes use the numpy form of every function not called before."""
    os.environ[_SWITCH] = "0"


def _typed(compiled: Any) -> Callable[..., Any]:
    function: Callable[..., Any] = compiled
    return function
