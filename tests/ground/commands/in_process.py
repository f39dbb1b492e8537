"""Runs `knightcube` command lines in the test process, to load modules and star catalogue only once."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from subprocess import CompletedProcess

from flight.app.cli import main
from tests.support.places import ROOT


def command(*arguments: str | Path, folder: Path = ROOT) -> CompletedProcess[str]:
    """Run a command in a folder, by default the repository, and return its exit status and outputs."""
    words = [str(word) for word in arguments]
    raw, complaint = io.BytesIO(), io.StringIO()
    output = io.TextIOWrapper(raw, encoding="utf-8", write_through=True)
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(complaint),
    ):
        try:
            status = main(words)
        except SystemExit as end:  # argparse exits after `--help` or wrong use
            status = end.code if isinstance(end.code, int) else 1
    return CompletedProcess(words, status, raw.getvalue().decode(), complaint.getvalue())
