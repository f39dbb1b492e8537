"""Marks as slow the tests listed in tests/slow.txt, which `make slow-list` measures and writes.

A test is listed when all its cases together take more than `LIMIT_S` of processor time, fixtures included.
`make quick` leaves slow tests out; a listed test that was renamed is not slow until the list is made again.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# No test may fail because the machine is busy.
settings.register_profile("any-machine", deadline=None)
settings.load_profile("any-machine")

LIMIT_S = 0.3
LIST = Path(__file__).with_name("slow.txt")
_spent: dict[str, float] = {}


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that measures."""
    parser.addoption("--write-slow-list", action="store_true", help=f"write {LIST.name} from this run")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what the list names."""
    listed = set(LIST.read_text(encoding="utf-8").split()) if LIST.exists() else set()
    for item in items:
        if _function(item) in listed:
            item.add_marker(pytest.mark.slow)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Measure a test's processor time, its fixtures and child processes included."""
    begun = _processor_s()
    yield
    name = _function(item)
    _spent[name] = _spent.get(name, 0.0) + _processor_s() - begun


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write the list when asked to."""
    if session.config.getoption("--write-slow-list"):
        slow = sorted(name for name, spent in _spent.items() if spent > LIMIT_S)
        LIST.write_text("\n".join(slow) + "\n", encoding="utf-8")


def _function(item: pytest.Item) -> str:
    return item.nodeid.partition("[")[0]


def _processor_s() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
