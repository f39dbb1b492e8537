"""The configurations that the package carries: those of the repository's folder config/, by a link to it."""

from __future__ import annotations

import re
from pathlib import Path

FOLDER = Path(__file__).parent / "configurations"


def config_path(text: str) -> Path:
    """Return the file that an argument names: a carried configuration by its bare name, or a path.

    `step_demo` is carried; `step_demo.yaml` and `./step_demo` are paths.
    """
    carried = FOLDER / f"{text}.yaml"
    return carried if re.fullmatch(r"\w+", text) and carried.is_file() else Path(text)


def names() -> list[str]:
    """Return the bare names of the carried configurations."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))
