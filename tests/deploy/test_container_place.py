"""Folders that the container cannot see are known before it is booted."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.deploy.container import why_not_visible


@pytest.mark.parametrize("place", ["/tmp", "/proc/self", "/dev"])
def test_a_folder_below_the_containers_own_mounts_is_named(place: str) -> None:
    assert why_not_visible(Path(place)).startswith(f"{place} is hidden in the container")


def test_a_link_to_such_a_folder_is_followed(tmp_path: Path) -> None:
    link = tmp_path / "checkout"
    link.symlink_to("/proc")
    assert "hidden" in why_not_visible(link)


def test_a_folder_of_the_root_file_system_is_seen() -> None:
    assert why_not_visible(Path("/")) == ""
