"""Tests that no text contains a phrase that readers cannot understand easily (`REFUSED`)."""

from __future__ import annotations

import io
import re
import subprocess
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXEMPT = ("tests/style/test_phrases.py", "tests/studies/same_bytes/renamed_texts.yaml")
"""Files that are not checked: this file, and the texts of former versions."""

REFUSED = {
    r"(?<!there )\b(?:is|are|was|were) no\b(?! (?:longer|more|less|fewer|later|earlier)\b)": "is not a ...",
    r"\bso many\b": "the number",
    r"\bof late\b": "recently",
    r"\banew\b": "again",
    r"\bleft over\b": "residual, remaining",
    r"\btaken for\b": "mistaken for, treated as",
    r"\bbut for\b": "except for",
    r"\bby nothing\b": "not by anything",
    r"\blikewise\b": "also, in the same way",
    r"\b(?:is|are|was|were|nobody|not) told\b": "is reported",
    r"\bheard\b": "received",
    r"\bfelt\b": "measured",
    r"\bseen by\b": "measured by, visible to",
    r"\bin place of\b": "instead of",
    r"\bto be had\b": "available",
    r"\bthe ones that\b": "the noun, repeated",
}
"""Patterns of inversions, idioms and homely words, each with a plain English replacement."""

ANY = re.compile("|".join(REFUSED))
BEGINS = re.compile("|".join(pattern.removeprefix("(?<!there )").removeprefix(r"\b") for pattern in REFUSED))
"""`REFUSED` without its conditions on the preceding text. A search finds too many phrases, but is six times
faster."""
GAPS = str.maketrans('#"_', "   ")

PARTS = ("FSTRING_START", "FSTRING_MIDDLE", "FSTRING_END")
"""Names of the tokens into which Python divides a formatted string; in Python 3.11, it is one token."""
TEXT_TOKENS = (
    tokenize.STRING,
    tokenize.COMMENT,
    *(getattr(tokenize, name, tokenize.STRING) for name in PARTS),
)


def _masked(code: str) -> str:
    return re.sub(r"\S", "|", code)


def texts_of_python(source: str) -> str:
    """Return a Python source in which all code is masked except strings, comments and names of tests."""
    lines = source.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))
    legible, end = "", 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        named = token.type == tokenize.NAME and token.string.startswith("test_")
        if token.type not in TEXT_TOKENS and not named:
            continue
        first = starts[token.start[0] - 1] + token.start[1]
        last = starts[token.end[0] - 1] + token.end[1]
        text = source[first:last].replace("_", " ") if named else source[first:last]
        if re.match(r"[rR]?[fF]", text) and token.type == tokenize.STRING:
            text = re.sub(r"\{[^{}]*\}", lambda field: _masked(field.group()), text)
        legible += _masked(source[end:first]) + text
        end = last
    return legible


def refused_phrases(text: str) -> list[tuple[int, str, str]]:
    """Return the refused phrases of a text: line number, phrase and plain English. Phrases may span lines."""
    words = [
        (number, word)
        for number, line in enumerate(text.splitlines(), 1)
        for word in re.sub(r'[#"]', " ", line).split()
    ]
    flat = " ".join(word for _, word in words)
    return sorted(
        (words[flat.count(" ", 0, match.start())][0], match.group(), plain)
        for pattern, plain in REFUSED.items()
        for match in re.finditer(pattern, flat, re.IGNORECASE)
    )


def may_have_any(text: str) -> bool:
    """Return whether a text may contain a refused phrase.

    Code is searched like text, so a result of True must be confirmed by an exact search.
    """
    flat = " ".join(text.lower().translate(GAPS).split())
    return bool(BEGINS.search(flat) and ANY.search(flat))


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ('"""One.\n\nA crash is no\ndamage.\n"""\n', [(3, "is no")]),
        ("x = 1  # it is of\n# late\n", [(1, "of late")]),
        ('raise E(f"{x} is"\n  " no u4")\n', [(1, "is no")]),
        ('raise E("elements", f"are no elements: {x}")\n', [(1, "are no")]),
        ('a = "is"\nb = "no"\nheard = f"{heard} of"\n', []),
        ("def test_a_crash_is_no_damage(): pass\n", [(1, "is no")]),
        ('"""There is no star, and it is no longer bright."""\n', []),
        ('a = f"{heard}: taken for {b}"\n', [(1, "taken for")]),
    ],
)
def test_phrases_are_found_in_strings_comments_and_names_of_tests_only(
    source: str, expected: list[tuple[int, str]]
) -> None:
    assert [(line, phrase) for line, phrase, _ in refused_phrases(texts_of_python(source))] == expected
    assert may_have_any(source) or not expected


def test_no_text_contains_a_refused_phrase() -> None:
    kinds = (
        "*.py",
        "*.md",
        "*.y*ml",
        "*.toml",
        "*.html",
        "*.js",
        "*.css",
        "*.c",
        "*.sh",
        "Makefile",
        "deploy",
    )
    command = ["git", "ls-files", *kinds]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    found = []
    for name in names:
        path = ROOT / name
        if name in EXEMPT or not path.exists():
            continue
        text = path.read_text(encoding="utf-8")
        if not may_have_any(text):
            continue
        found += [
            f"{name}:{line}: `{phrase}`; plain English: {plain}"
            for line, phrase, plain in refused_phrases(
                texts_of_python(text) if path.suffix == ".py" else text
            )
        ]
    assert not found, "refused phrases:\n" + "\n".join(found)
