"""Runs a target on many inputs, each bounded in time, and collects what it finds."""

from __future__ import annotations

import resource
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Protocol

import numpy as np

MEMORY = 4 << 30
"""Bytes of address space that a campaign may take: more counts as a crash."""

LIMIT_S = 10.0
"""CPU time of one input, and a sixth of the time on the wall in which it must do something."""

_AWAKE_S = 0.1

_KEPT = 20


class Finding(Exception):
    """Corruption was accepted, or a promise broken; the text says which."""


class Hang(BaseException):
    """An input took too long. No Exception: a careless `except Exception` must not end the search."""


class Target(Protocol):
    """One door."""

    def attempt(self, draw: np.random.Generator) -> Counter[str]:
        """Feed one input; returns tallies of its kind and of its outcome. Raises Finding."""

    def last(self) -> str:
        """Return the last input, to be looked at."""


@dataclass
class Campaign:
    """What a campaign has come to."""

    name: str
    seed: int
    inputs: int = 0
    cpu_s: float = 0.0
    slowest_s: float = 0.0
    tallies: Counter[str] = field(default_factory=Counter)
    findings: list[dict[str, object]] = field(default_factory=list)
    distinct: Counter[str] = field(default_factory=Counter)

    @property
    def sound(self) -> bool:
        """Whether nothing was found."""
        return not self.distinct

    def found(self, kind: str, number: int, text: str, example: str) -> None:
        """Keep the first finding of each kind."""
        self.distinct[kind] += 1
        if self.distinct[kind] == 1 and len(self.findings) < _KEPT:
            self.findings.append({"kind": kind, "input": number, "text": text, "example": example[:4000]})


def run(
    name: str,
    target: Target,
    inputs: int,
    seed: int,
    *,
    first: int = 0,
    progress: Callable[[Campaign], None] = lambda _: None,
) -> Campaign:
    """Feed inputs number `first` and following."""
    campaign = Campaign(name, seed)
    with _watchdog(), _frugal():
        for number in range(first, first + inputs):
            began = time.process_time()
            try:
                with _bounded():
                    campaign.tallies += target.attempt(np.random.default_rng([seed, number]))
            except Hang:
                campaign.found(f"hang at {_place()}", number, f"{LIMIT_S} s of CPU", target.last())
            except Finding as finding:
                campaign.found(f"accepted: {str(finding)[:60]}", number, str(finding), target.last())
            except Exception as error:  # noqa: BLE001 - the campaign looks for any crash
                text = "".join(traceback.format_exception(error)[-4:])
                campaign.found(f"{type(error).__name__} at {_place()}", number, text, target.last())
            took = time.process_time() - began
            campaign.inputs += 1
            campaign.cpu_s += took
            campaign.slowest_s = max(campaign.slowest_s, took)
            progress(campaign)
    return campaign


def _place() -> str:
    """Return file and line of the innermost frame of the exception being handled that is not a library's."""
    trace = traceback.extract_tb(sys.exc_info()[2])
    ours = [
        step for step in trace if "site-packages" not in step.filename and "/tests/fuzz/" not in step.filename
    ]
    step = (ours or trace)[-1]
    return f"{step.filename.rpartition('/')[2]}:{step.lineno}"


@contextmanager
def _watchdog() -> Iterator[None]:
    """Have both timers raise Hang in the main thread.

    That of the wall does so when next to no CPU was used since it came last: a busy machine is no hang.
    """
    before_s = 0.0

    def bite(number: int, _: FrameType | None) -> None:
        nonlocal before_s
        used_s, before_s = time.process_time() - before_s, time.process_time()
        if number == signal.SIGPROF or used_s < _AWAKE_S:
            raise Hang(signal.Signals(number).name)

    numbers = (signal.SIGPROF, signal.SIGALRM)
    before = {number: signal.signal(number, bite) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _frugal() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@contextmanager
def _bounded() -> Iterator[None]:
    signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
    signal.setitimer(signal.ITIMER_REAL, 6.0 * LIMIT_S, 6.0 * LIMIT_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
