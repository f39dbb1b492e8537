"""Tests that folders that would be hidden in the container are mounted before the container boots."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.deploy.container import needs_mount


@pytest.mark.parametrize("place", ["/tmp", "/proc/self", "/dev"])
def test_a_folder_below_the_mounts_of_the_container_needs_a_mount(place: str) -> None:
    assert needs_mount(Path(place))


def test_a_link_to_such_a_folder_is_followed(tmp_path: Path) -> None:
    link = tmp_path / "checkout"
    link.symlink_to("/proc")
    assert needs_mount(link)


def test_a_folder_of_the_root_file_system_needs_no_mount() -> None:
    assert not needs_mount(Path("/"))
