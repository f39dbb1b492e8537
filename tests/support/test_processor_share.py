"""Tests of the control groups that limit processor and memory, with recorded files of cgroup v1 and v2.

The v2 files are from a user-mode Linux 6.1 (`tests/studies/bench/user_mode_linux.sh`), and the v1 files from
Linux 6.18. The files were recorded after a process with a limit of 30 % and 64 MiB had requested 100 MB.
"""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from tests.support.processor_share import Limits, Used, limited

NAME = f"knightcube-board-{os.getpid()}"
V2_STAT = (
    "usage_usec 6110000\nuser_usec 6089857\nsystem_usec 20142\nnr_periods 4391\nnr_throttled 3419\n"
    "throttled_usec 15850000\nnr_bursts 0\nburst_usec 0\n"
)
V1_STAT = "nr_periods 57\nnr_throttled 41\nthrottled_time 159907408\nnr_bursts 0\nburst_time 0\n"
V2_EVENTS = "low 0\nhigh 0\nmax 37\noom 1\noom_kill 1\noom_group_kill 0\n"


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder whose subfolders are removed with their files, as the kernel removes groups."""
    monkeypatch.setattr(Path, "rmdir", shutil.rmtree)
    return tmp_path


@pytest.fixture
def unified(root: Path) -> Path:
    """Return the root of a hierarchy of cgroup v2."""
    (root / "cgroup.controllers").write_text("cpu io memory pids\n", encoding="ascii")
    return root


@pytest.fixture
def separate(root: Path) -> Path:
    """Return a folder with the hierarchies `cpu` and `memory` of cgroup v1."""
    for controller in ("cpu", "memory"):
        (root / controller).mkdir()
    return root


def settings(root: Path) -> dict[str, str]:
    """Return the texts of all files below `root`, by path."""
    files = (path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)).replace(NAME, "BOARD"): path.read_text() for path in files}


def test_the_groups_of_cgroup_v2_have_one_folder_for_processor_and_memory(unified: Path) -> None:
    limits = Limits(0.3, 64 << 20, unified)
    assert settings(unified) == {
        "cgroup.controllers": "cpu io memory pids\n",
        "cgroup.subtree_control": "+cpu +memory",
        "BOARD/cgroup.subtree_control": "+cpu",
        "BOARD/cpu.max": "1500 5000",
        "BOARD/cpu.weight": "10000",
        "BOARD/memory.max": "67108864",
        "BOARD/control/cpu.weight": "10000",
        "BOARD/workers/cpu.weight": "1",
        "BOARD-devices/cpu.weight": "10000",
    }
    assert f"{[str(unified / NAME / 'control/cgroup.procs')]!r}" in limits.line()
    limits.demote(17)
    limits.release(18)
    assert (unified / NAME / "workers/cgroup.procs").read_text() == "17"
    assert (unified / f"{NAME}-devices/cgroup.procs").read_text() == "18"
    limits.close()
    assert sorted(path.name for path in unified.iterdir()) == ["cgroup.controllers", "cgroup.subtree_control"]


def test_the_groups_of_cgroup_v1_are_in_two_hierarchies(separate: Path) -> None:
    limits = Limits(0.3, 64 << 20, separate)
    found = settings(separate)
    assert found["cpu/BOARD/cpu.cfs_quota_us"] == "1500"
    assert found["cpu/BOARD/cpu.cfs_period_us"] == "5000"
    assert found["memory/BOARD/memory.limit_in_bytes"] == "67108864"
    assert found["cpu/BOARD/workers/cpu.shares"] == "2"
    for group in ("cpu/BOARD/control", "memory/BOARD"):
        assert str(separate / group.replace("BOARD", NAME) / "cgroup.procs") in limits.line()
    limits.close()
    assert not settings(separate)


@pytest.mark.parametrize(("share", "limit"), [(0.3, "1500 5000"), (0.05, "1000 20000"), (1.0, "5000 5000")])
def test_a_small_share_has_a_longer_period_with_the_shortest_quota(
    share: float, limit: str, unified: Path
) -> None:
    Limits(share, 64 << 20, unified)
    assert (unified / NAME / "cpu.max").read_text() == limit


@pytest.mark.parametrize(("peak", "memory"), [("67108864\n", 67108864.0), (None, math.nan)])
def test_what_a_group_of_cgroup_v2_used_is_read_also_without_the_largest_memory(
    peak: str | None, memory: float, unified: Path
) -> None:
    limits, group = Limits(0.3, 64 << 20, unified), unified / NAME
    (group / "cpu.stat").write_text(V2_STAT)
    (group / "memory.events").write_text(V2_EVENTS)
    if peak is not None:
        (group / "memory.peak").write_text(peak)
    used = limits.used()
    assert (used.periods, used.throttled, used.refusals) == (4391, 3419, 37)
    assert used.memory == pytest.approx(memory, nan_ok=True)


def test_what_groups_of_cgroup_v1_used_is_read(separate: Path) -> None:
    limits = Limits(0.3, 64 << 20, separate)
    (separate / "cpu" / NAME / "cpu.stat").write_text(V1_STAT)
    (separate / "memory" / NAME / "memory.failcnt").write_text("36\n")
    (separate / "memory" / NAME / "memory.max_usage_in_bytes").write_text("67108864\n")
    assert limits.used() == Used(57, 41, 67108864.0, 36)


def test_a_refused_controller_is_named_and_leaves_no_group(unified: Path) -> None:
    """A controller that the kernel refuses is named in the error, and no group remains.

    In a container, the kernel refuses controllers in the group of the processes (errno EBUSY).
    """
    (unified / "cgroup.subtree_control").mkdir()
    with pytest.raises(OSError, match=r"the kernel refuses '\+cpu \+memory': .*cgroup.subtree_control"):
        Limits(0.3, 64 << 20, unified)
    assert not (unified / NAME).exists()


@pytest.mark.slow
def test_the_kernel_limits_processor_and_memory_of_a_process() -> None:
    spin = """
    import time
    begun, used = time.monotonic(), time.process_time()
    while time.monotonic() < begun + 2.0:
        pass
    print((time.process_time() - used) / (time.monotonic() - begun))
    bytearray(100 << 20)
    """
    try:
        with limited(0.3, 64 << 20) as limits:
            program = f"import os\n{limits.line()}\n{textwrap.dedent(spin)}"
            words = [sys.executable, "-u", "-c", program]
            done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
            used = limits.used()
    except OSError as error:
        pytest.skip(f"no groups can be made here: {error}")
    assert float(done.stdout) < 0.33
    assert used.throttled > 0
    assert used.refusals > 0, "the process asked for more memory than its group may use"
    assert not used.memory > 64 << 20
