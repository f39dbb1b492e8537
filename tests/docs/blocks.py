"""Code blocks of the documentation, and their marks.

A test runs a block of commands (`sh` or `console`), unless the line before it is a comment `<!-- run by: PATH
-->`, which names the test that runs its commands, or `<!-- not run: REASON -->`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

_FENCE = re.compile(r"^(?P<indent> *)```(?P<language>\w*)")
_MARK = re.compile(r"<!-- (?P<kind>run by|not run): (?P<text>.+) -->")


@dataclass(frozen=True)
class Block:
    """One fenced code block.

    `line` is the line number of its fence; `mark` is empty, "run by" or "not run".
    """

    page: str
    line: int
    language: str
    text: str
    mark: str = ""
    reason: str = ""

    @property
    def commands(self) -> list[str]:
        """Commands of a shell block without prompts, comments and continuations; empty for other blocks."""
        if self.language not in {"sh", "console"}:
            return []
        lines = self.text.replace("\\\n", " ").splitlines()
        if self.language == "console":
            lines = [line[2:] for line in lines if line.startswith("$ ")]
        bare = (re.sub(r"(^|\s+)#\s.*$", "", line).strip() for line in lines)
        return [line for line in bare if line]


def pages() -> list[Path]:
    """Return the paths of all pages of the documentation."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks_of(text: str, page: str = "") -> list[Block]:
    """Return the fenced blocks of a page's text."""
    found: list[Block] = []
    lines = text.splitlines()
    index = 0
    while index < len(lines):
        fence = _FENCE.match(lines[index])
        if fence is None:
            index += 1
            continue
        indent = len(fence["indent"])
        end = next(k for k in range(index + 1, len(lines)) if lines[k].strip() == "```")
        mark = _MARK.fullmatch(lines[index - 1].strip()) if index else None
        body = "\n".join(line[indent:] for line in lines[index + 1 : end])
        kind, reason = (mark["kind"], mark["text"]) if mark else ("", "")
        found.append(Block(page, index + 1, fence["language"], body, kind, reason))
        index = end + 1
    return found


def blocks() -> list[Block]:
    """Return the fenced blocks of all pages."""
    return [
        block
        for path in pages()
        for block in blocks_of(path.read_text(encoding="utf-8"), str(path.relative_to(ROOT)))
    ]
