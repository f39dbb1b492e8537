"""Converts texts of the old revision to the wording of this checkout, by the table `renamed_texts.yaml`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import yaml

TABLE = Path(__file__).with_name("renamed_texts.yaml")
_PLACEHOLDER = re.compile(r"\{(\w+)\}")


class Texts:
    """Converter of renamed texts."""

    def __init__(self, pairs: Iterable[Mapping[str, str]] = ()) -> None:
        """Create the table from pairs of `old` and `new`.

        Raises ValueError for a pair with other keys or placeholders.
        """
        self._pairs = [_compiled(pair) for pair in pairs]

    @classmethod
    def read(cls, path: Path = TABLE) -> Texts:
        """Return the table of a file. Raises ValueError if it is not a list of pairs."""
        pairs = yaml.safe_load(path.read_text(encoding="utf-8"))
        if not isinstance(pairs, list):
            raise ValueError(f"{path}: not a list of pairs of old and new")
        return cls(pairs)

    def renamed(self, text: str) -> str:
        """Return a text of the old revision in the wording of the new one."""
        for old, new in self._pairs:
            found = old.fullmatch(text)
            if found is not None:
                words = found.groupdict()
                text = _PLACEHOLDER.sub(lambda place, words=words: words[place[1]], new)  # type: ignore[misc]  # mypy infers no type for a lambda with a default
        return text


def _compiled(pair: Mapping[str, str]) -> tuple[re.Pattern[str], str]:
    """Return the pattern of the old text, and the new text."""
    if not isinstance(pair, dict) or set(pair) != {"old", "new"}:
        raise ValueError(f"renamed text {pair!r}: a pair has the keys old and new")
    pieces = _PLACEHOLDER.split(pair["old"])  # texts alternate with placeholder names
    if set(_PLACEHOLDER.findall(pair["new"])) - set(pieces[1::2]):
        raise ValueError(f"renamed text {pair['new']!r}: a placeholder is not in the old text")
    pattern = "".join(
        f"(?P<{piece}>.*)" if number % 2 else re.escape(piece) for number, piece in enumerate(pieces)
    )
    return re.compile(pattern, re.DOTALL), pair["new"]
