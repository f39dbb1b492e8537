"""Tests that Ctrl-C, closed pipes and too small images give an exit status and at most one line."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from flight.app.service import EndingSignals
from tests.ground.commands.in_process import command
from tests.ground.report.synthetic import Recipe, make_run
from tests.support.places import ROOT


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run"), Recipe(duration=5.0))


def shell(line: str) -> subprocess.CompletedProcess[str]:
    """Run a shell line, in which a pipe fails if any of its commands fails."""
    words = ["bash", "-o", "pipefail", "-c", line.replace("FLIGHT", f"{sys.executable} -m flight")]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)


@pytest.mark.parametrize("ending", ["| true", ">&-", ">&- 2>&-", "<&- >&- 2>&-", "2>&1 | true"])
def test_a_closed_pipe_does_not_count_as_a_failure(ending: str, run_folder: Path) -> None:
    done = shell(f"FLIGHT report {run_folder} --no-figures {ending}")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("words", ["--help", "report RUN --no-figures"])
def test_output_that_does_not_fit_the_disk_is_one_line(words: str, run_folder: Path) -> None:
    done = shell(f"FLIGHT {words} > /dev/full".replace("RUN", str(run_folder)))
    assert (done.returncode, done.stderr) == (1, "knightcube: No space left on device\n")


def test_ctrl_c_ends_a_command_by_the_signal_itself_from_its_first_import_on() -> None:
    """Ctrl-C ends a command even during its first import, in which Python code cannot handle the signal."""
    script = (
        # Restore the default handler as in a terminal, because commands that a shell starts by `&` ignore the
        # signal.
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "import flight.__main__\n"
        "assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL\n"
        "signal.raise_signal(signal.SIGINT)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, b"")
    source = (ROOT / "flight" / "__main__.py").read_text(encoding="utf-8")
    assert source.index("SIG_DFL") < source.index("from flight"), "before anything is imported"


class _Loop:
    reason = ""

    def stop(self, reason: str) -> None:
        self.reason = reason


def test_a_signal_while_a_flight_opens_ends_the_flight_at_its_first_cycle() -> None:
    loop = _Loop()
    with EndingSignals() as signals:
        signal.raise_signal(signal.SIGINT)
        assert loop.reason == ""
        signals.end(loop)  # type: ignore[arg-type]  # only `stop` is called
        assert loop.reason == "stopped by SIGINT"
    assert signals.received


def test_a_second_signal_interrupts_the_opening_and_the_handlers_are_put_back() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with EndingSignals():
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_hangup_that_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup
    try:
        with EndingSignals() as signals:
            signal.raise_signal(signal.SIGHUP)
            assert not signals.received
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("shape", [(1, 1), (3, 2000), (2000, 3)])
@pytest.mark.parametrize("words", ["solve", "calibrate", "rate --fov 20 --exposure 0.2", "horizon --fov 60"])
def test_a_picture_too_small_to_show_anything_is_refused(
    words: str, shape: tuple[int, int], tmp_path: Path
) -> None:
    path = tmp_path / "small.png"
    Image.fromarray(np.ones(shape, np.uint8)).save(path)
    name, *options = words.split()
    done = command(name, path, *options)
    assert done.returncode == 2
    assert done.stderr == f"knightcube: {path}: {shape[1]} x {shape[0]} pixels: give 16 or more per side\n"


@pytest.mark.parametrize("method", ["likelihood", "harris"])
@pytest.mark.parametrize(
    ("value", "status", "reason"),
    [(0, "black", "all pixels of the frame are equal"), (255, "saturated", "the frame is overexposed")],
)
def test_a_frame_of_one_value_is_black_or_saturated_and_has_no_length(
    value: int, status: str, reason: str, method: str, tmp_path: Path
) -> None:
    path = tmp_path / "flat.png"
    Image.fromarray(np.full((64, 64), value, np.uint8)).save(path)
    done = command("rate", path, "--fov", "20", "--exposure", "0.2", "--method", method)
    assert done.returncode == 1
    assert done.stdout.startswith(f"status:        {status}\nreason:        {reason}: ")
    assert done.stdout.endswith("\nstreaks:       0 found, 0 used\n")
