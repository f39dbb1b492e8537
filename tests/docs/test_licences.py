"""Tests that the page of licences lists each locked package with the licence that its metadata states."""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LOCKS = ("deploy/requirements.lock", "requirements.lock", "requirements-test.lock")
STATED = {
    "MIT": "MIT",
    "BSD": "BSD|Enthought",
    "Apache-2.0": "Apache",
    "Apache-2.0 or BSD": "Apache-2.0 OR BSD",
    "PSF": "PSF|Python Software Foundation",
    "ISC": "ISC",
    "MPL-2.0": "MPL",
    "GPL-3.0-or-later": "GNU General Public License v3 or later",
    "AGPL-3.0": "AGPL-3.0",
    "LGPL-2.1": "LGPL-2.1",
    "LGPL-3.0": "LGPLv3",
    "Unlicense or MIT-0": "Unlicense|Public Domain",
}
"""Pattern of each licence's text in package metadata."""


def _rows() -> dict[str, list[list[str]]]:
    """Return the packages by licence, as lists for a board, the demonstration and the tests."""
    page = (ROOT / "docs" / "licences.md").read_text(encoding="utf-8")
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line[:1] == "|"
    ]
    return {
        licence: [[] if cell == "-" else cell.split(", ") for cell in cells] for licence, *cells in rows[2:]
    }


@pytest.mark.parametrize("column", range(3), ids=LOCKS)
def test_the_page_lists_exactly_the_packages_that_a_lock_adds(column: int) -> None:
    pins = [
        {re.sub(r"[-_.]+", "-", name).lower() for name in re.findall(r"^([\w.-]+)==", text, re.MULTILINE)}
        for text in ((ROOT / lock).read_text(encoding="utf-8") for lock in LOCKS)
    ]
    listed = sorted(name for columns in _rows().values() for name in columns[column])
    assert listed == sorted(pins[column].difference(*pins[:column]))


@pytest.mark.parametrize("licence", STATED)
def test_each_package_states_the_licence_of_its_row(licence: str) -> None:
    for name in (name for column in _rows()[licence] for name in column):
        fields = metadata.metadata(name)
        classifiers = [text for text in fields.get_all("Classifier") or [] if text.startswith("License")]
        stated = [fields[key] for key in ("License-Expression", "License") if key in fields] + classifiers
        stated = stated or [metadata.distribution(name).read_text("licenses/LICENSE") or ""]
        assert re.search(STATED[licence], " ".join(stated)), name


def test_a_board_and_the_demonstration_install_no_package_under_a_gpl() -> None:
    for licence, (board, demo, _) in _rows().items():
        assert "GPL" not in licence or not board + demo
