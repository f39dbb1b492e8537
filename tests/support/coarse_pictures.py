"""Pictures with few pixels and without layout, for tests of commands that also draw pictures."""

from __future__ import annotations

import pytest

from ground.report import figures

DPI = 15
"""Resolution of the pictures (px per inch)."""


def draw_coarsely(patch: pytest.MonkeyPatch) -> None:
    """Make reports draw coarse pictures, to save processor time.

    All elements of a picture are still drawn and written. The tests in `tests/ground/report` draw pictures
    with the full layout.
    """
    engine = pytest.importorskip("matplotlib.layout_engine").ConstrainedLayoutEngine
    patch.setattr(figures, "DPI", DPI)
    patch.setattr(engine, "execute", lambda _, figure: None)
