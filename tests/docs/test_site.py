"""Tests that the site has a reference of every module, and that the check of built pages finds faults."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import knightcube
from tests.docs.blocks import ROOT
from tests.docs.built_site import problems_of


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


def test_the_page_of_the_library_links_every_exported_name() -> None:
    page = (ROOT / "docs" / "library" / "index.md").read_text(encoding="utf-8")
    linked = dict(re.findall(r"\[(\w+)\]\[([\w.]+)\.\w+\]", page))
    assert linked.keys() == set(vars(knightcube)["__all__"])
    assert all(hasattr(import_module(module), name) for name, module in linked.items())


def test_every_picture_is_in_the_gallery_with_its_command() -> None:
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"\]\(pictures/(\w+\.png)\)", page))
    assert shown == {path.name for path in (ROOT / "docs" / "pictures").glob("*.png")}
