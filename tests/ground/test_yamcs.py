"""Yamcs, a ground station of other authors, loads our configuration and our XTCE without a warning.

`python -m tests.studies.interop.yamcs FOLDER` flies under it; that takes a minute and more.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from ground.yamcs import main
from tests.studies.interop.yamcs_server import check, missing


@pytest.mark.skipif(bool(missing()), reason=missing())
def test_yamcs_loads_configuration_and_xtce_without_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["yamcs", str(tmp_path), "--epoch", "2026-11-23T12:00:00"])
    main()
    assert check(tmp_path) == (0, [])
