"""Build hooks of the documentation site: guides are listed before module pages in the search results."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkdocs.structure.pages import Page

_MODULE_PAGES = "reference/"
_WEIGHT_OF_MODULES = 0.2  # relative to a guide with the same words


def on_page_markdown(markdown: str, *, page: Page, **_: Any) -> str:
    """Lower the weight of the page of a module in the search; return its text unchanged."""
    if page.file.src_uri.startswith(_MODULE_PAGES):
        page.meta["search"] = {"boost": _WEIGHT_OF_MODULES}
    return markdown
