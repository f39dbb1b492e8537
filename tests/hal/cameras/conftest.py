"""Test double of the kernel's camera interface, and fixtures for each frame source."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.hal.cameras.ioctl_camera import IoctlCamera
from tests.hal.cameras.rig import Rig, aravis_rig, emulated_rig, kernel_in, video_rig
from tests.manual_clock import ManualClock


@pytest.fixture
def clock() -> ManualClock:
    """Return a manual clock."""
    return ManualClock()


@pytest.fixture
def kernel(tmp_path: Path, clock: ManualClock, monkeypatch: pytest.MonkeyPatch) -> Iterator[IoctlCamera]:
    """Replace the kernel's V4L2 by a camera that is plugged in."""
    camera = kernel_in(tmp_path, clock, monkeypatch)
    yield camera
    camera.close()


@pytest.fixture(params=["emulated", "v4l2", "aravis"])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    """Return each type of frame source in turn."""
    if request.param == "emulated":
        made = emulated_rig()
    elif request.param == "aravis":
        made = aravis_rig()
    else:
        made = video_rig(request.getfixturevalue("kernel"), request.getfixturevalue("clock")).rig
    yield made
    made.source.close()
