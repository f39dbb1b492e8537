"""Campaign `link-start`: each system call of the link's start fails once, and the link comes up all the same.

It is the campaign `start` with a link, more kinds of calls and one more error. The service manager starts the
link again after any end, so a link is lost only if it does not come up once the fault is gone. The summary
also counts the ends with status 2, which stand for a configuration that was read whole and is wrong: a fault
that passes must not cause one.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from knightcube.errors import UsageError
from tests.studies.campaigns.start import CALLS, Board, cases_of, check_injection, points
from tests.studies.campaigns.start import summarise as summarise_starts
from tests.support.linked_board import write_linked_config

LINK_CALLS = (
    *CALLS,
    "mkdir",
    "unlink",
    "flock",
    "socket",
    "setsockopt",
    "listen",
    "pwrite64",
    "ftruncate",
    "sendto",
)
ERRORS = ("EIO", "ENOSPC", "ENOENT", "EACCES", "EROFS")


def cases(runs: int, seed: int) -> list[Case]:
    """Trace a start; return boards for the first `runs` points."""
    with _board() as board:
        return cases_of(points(*board.trace(), ERRORS, LINK_CALLS), runs, seed)


def run(case: Case) -> Result:
    """Start the link of one board with one fault after the other."""
    with _board() as board:
        board.trace()
        faults = [
            {"fault": f"{call} {number}: {error}", "begun": begun}
            | board.start(f"{call}:error={error}:when={number}")
            for call, number, error, begun in case.parameters["faults"]
        ]
    return {"faults": faults, "of": case.parameters["of"]}


@contextmanager
def _board() -> Iterator[Board]:
    """Provide a board with keys and a link. Raises UsageError without strace."""
    if shutil.which("strace") is None:
        raise UsageError("the campaign link-start needs strace")
    check_injection()
    with tempfile.TemporaryDirectory(prefix="kc-") as name:
        place = Path(name)
        config = write_linked_config(place, udp="127.0.0.1:0", tcp="127.0.0.1:0")
        board = Board(place, ["link", config, "--log", place / "runs"], place / "state", LINK_CALLS)
        try:
            yield board
        finally:
            board.close()


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Count how the starts went, and the ends with status 2."""
    faults = [fault for result in results for fault in result["faults"]]
    judged = [fault["fault"] for fault in faults if 2 in fault["statuses"]]
    found = summarise_starts(results, folder)
    return summary({**found.facts, "judged_wrong": judged})


LINK_START = Campaign(
    "link-start",
    "every system call of the link's start fails once: it comes up, at once or later",
    cases,
    run,
    summarise,
    400,
)
