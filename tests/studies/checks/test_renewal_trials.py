"""Runs a slice of the campaign `renewal-trials`: one confirmed update, and one whose release cannot start."""

from __future__ import annotations

import shutil

import pytest

from ground.campaigns.runner import Case
from tests.studies.campaigns.renewal_trials import FLAWS, cases, run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("systemctl") is None, reason="systemctl is missing: install systemd"),
]


@pytest.mark.parametrize(
    ("kind", "flaw", "which"),
    [("configuration", "", "new"), ("configuration", "body", "old"), ("release", "", "new")],
)
def test_the_old_or_the_new_version_flies_and_the_link_answers(kind: str, flaw: str, which: str) -> None:
    result = run(Case("0", (3, len(flaw)), {"kind": kind, "flaw": flaw, "confirmed": True}))
    assert (result["which"], result["answers"], result["kept"]) == (which, True, which == "new"), result


def test_every_flaw_of_each_kind_is_tried() -> None:
    tried = {(case.parameters["kind"], case.parameters["flaw"]) for case in cases(200, 1)}
    assert tried == {(kind, flaw) for kind, flaws in FLAWS.items() for flaw in flaws}
