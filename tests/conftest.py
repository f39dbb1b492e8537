"""Marks the tests of tests/slow.txt as slow, and sorts the test files by their durations in tests/order.txt.

`make slow-list` measures and writes both lists. A test is slow if all its cases together take more than
`LIMIT_S` of processor time. The processor time of a test includes fixtures, and excludes the compilation of
functions, because only runs with slow tests compile functions (`tests.support.compiled_forms`). `make quick`
omits slow tests. A renamed test is not marked as slow until the list is measured again. Test files that last
longer than `LONG_S` run first, in the order of decreasing duration, so that the workers of `make test` finish
at nearly the same time. A test file that waits for processes or sockets lasts longer than its processor time.
"""

from __future__ import annotations

import fcntl
import gc
import importlib
import os
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

# `python -m flight` sets the same number of threads. With more threads, the idle threads of OpenBLAS would
# use a third of the processor time. No test imports numpy before this file is imported, and programs that
# tests start inherit the setting.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# The tests check the numpy implementations of functions that numba can compile. The compiled implementations
# are compared with the numpy implementations. With the numpy implementations, results equal recorded results
# byte for byte, and programs that tests start do not load numba.
os.environ.setdefault("KNIGHTCUBE_COMPILED", "0")
# While numba compiles a function, it formats messages of rejected overloads that nobody reads.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

# No test may fail because the machine is busy, or because hypothesis draws a rare example in one of many
# runs. All runs use the same examples, so a larger number of examples would slow each run without new
# findings.
settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=40)
settings.register_profile("explore", deadline=None, max_examples=100)
settings.load_profile("repeatable")

from tests.support import compiled_forms  # noqa: E402  # after the settings above

LIMIT_S = 0.3
LONG_S = 1.0
LIST = Path(__file__).with_name("slow.txt")
ORDER = Path(__file__).with_name("order.txt")
_spent: dict[str, float] = {}
"""Processor time (s) of each test."""
_lasted: dict[str, float] = {}
"""Duration (s) of each test file, or its processor time (s) if the processor time is longer."""


@pytest.fixture(scope="session")
def session_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder that all worker processes of this session share."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return the number of workers for `-n auto`, one more than the cores, because many tests wait."""
    return len(os.sched_getaffinity(0)) + 1


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Let one worker process run all files whose tests compile functions.

    Some functions of numba, such as that of `np.empty`, are compiled again in each process that compiles a
    function that calls them. This takes some seconds.
    """
    if config.getoption("dist") != "loadfile":
        return None
    scheduling = importlib.import_module("xdist.scheduler").LoadFileScheduling(config, log)
    file_of = scheduling._split_scope
    compiling = {
        path.relative_to(config.rootpath).as_posix()
        for path in Path(__file__).parent.rglob("test_*.py")
        if "compiled_forms" in path.read_text(encoding="utf-8")
    }

    def scope_of(nodeid: str) -> str:
        file = str(file_of(nodeid))
        return "compiling" if file in compiling else file

    scheduling._split_scope = scope_of
    return scheduling


@pytest.hookimpl(hookwrapper=True)
def pytest_collection() -> Iterator[None]:
    """Import the tests in one worker process after another, without garbage collection.

    In a new clone, the first worker compiles each module and stores the bytecode, and the other workers load
    it. If all workers imported at once, each worker would compile all modules.
    """
    gc.disable()
    with Path(__file__).open(encoding="utf-8") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        yield
    gc.freeze()
    gc.enable()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option `--write-slow-list`, which writes the durations of the tests."""
    parser.addoption("--write-slow-list", action="store_true", help=f"write {LIST.name} from this run")


def pytest_configure(config: pytest.Config) -> None:
    """Disable the compilation of functions in runs without slow tests."""
    compiled_forms.compiles = config.getoption("markexpr") != "not slow"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the listed tests as slow, and sort the files by decreasing duration."""
    listed, of_file = _seconds(LIST), _seconds(ORDER)
    for item in items:
        if _function(item) in listed:
            item.add_marker(pytest.mark.slow)
    items.sort(key=lambda item: -of_file.get(item.nodeid.partition("::")[0], 0.0))


def _seconds(path: Path) -> dict[str, float]:
    """Return the times (s) in a list, by the name of the test or test file."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {name: float(spent) for name, _, spent in (line.rpartition(" ") for line in lines)}


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Measure a test's processor time and duration, including its fixtures and child processes."""
    begun, clock, compiled_s = _processor_s(), time.monotonic(), compiled_forms.compiling_s
    yield
    name, spent = _function(item), _processor_s() - begun
    file = name.partition("::")[0]
    _spent[name] = _spent.get(name, 0.0) + spent - (compiled_forms.compiling_s - compiled_s)
    _lasted[file] = _lasted.get(file, 0.0) + max(spent, time.monotonic() - clock)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write tests/slow.txt and tests/order.txt if the option `--write-slow-list` is set."""
    if session.config.getoption("--write-slow-list"):
        slow = sorted(f"{name} {spent:.1f}" for name, spent in _spent.items() if spent > LIMIT_S)
        LIST.write_text("\n".join(slow) + "\n", encoding="utf-8")
        longest = sorted(_lasted.items(), key=lambda entry: -entry[1])
        lines = [f"{file} {seconds:.0f}\n" for file, seconds in longest if seconds > LONG_S]
        ORDER.write_text("".join(lines), encoding="utf-8")


def _function(item: pytest.Item) -> str:
    return item.nodeid.partition("[")[0]


def _processor_s() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
