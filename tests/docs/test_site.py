"""The site is complete: every module has its reference, and the check of the built pages can fail."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import knightcube
from tests.docs.blocks import ROOT
from tests.docs.built_site import problems_of


def test_every_module_stands_in_the_api_reference() -> None:
    named = {
        name
        for page in (ROOT / "docs" / "reference").glob("*.md")
        for name in re.findall(r"^::: ([\w.]+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    }
    for package in ("knightcube", "flight", "hal", "sim_hal", "ground"):
        for path in (ROOT / package).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            if parts[-1].startswith("__"):
                continue
            above = {".".join(parts[: k + 1]) for k in range(len(parts))}
            assert above & named, f"{path.relative_to(ROOT)} is on no page of docs/reference"


def test_a_page_that_loads_from_another_host_is_found(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        '<script src="https://elsewhere.example/x.js"></script>', encoding="utf-8"
    )
    (tmp_path / "b.html").write_text("<p>TODO</p>", encoding="utf-8")
    (tmp_path / "c.css").write_text("@import url(//fonts.example/f.css);", encoding="utf-8")
    assert len(problems_of(tmp_path)) == 3


def test_links_to_follow_are_not_reported(tmp_path: Path) -> None:
    page = '<a href="https://elsewhere.example/">there</a><link rel="stylesheet" href="assets/own.css">'
    (tmp_path / "a.html").write_text(page, encoding="utf-8")
    assert problems_of(tmp_path) == []


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


def test_the_reference_of_the_public_interface_lists_every_exported_name() -> None:
    page = (ROOT / "docs" / "reference" / "knightcube.md").read_text(encoding="utf-8")
    listed = {name for names in re.findall(r"members: \[(.+)\]", page) for name in names.split(", ")}
    assert set(knightcube.__all__) <= listed
    for module, names in re.findall(r"^::: (\S+)\n.*\n.*members: \[(.+)\]", page, re.MULTILINE):
        assert all(hasattr(import_module(module), name) for name in names.split(", "))
