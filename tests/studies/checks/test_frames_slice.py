"""Runs a small slice of the campaign `frames`, and tests the faults that it would detect."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from flight.link.security import Gate
from tests.studies.campaigns.frames import FRAMES, FRAMES_CAMPAIGN, KINDS, STARTS, run

SEED = 35


def test_no_frame_is_obeyed_twice_and_none_ends_the_process(tmp_path: Path) -> None:
    results = [run(case) for case in FRAMES_CAMPAIGN.cases(len(STARTS), SEED)]
    facts = FRAMES_CAMPAIGN.summarise(results, tmp_path).facts
    json.dumps(facts, allow_nan=False)
    assert facts["frames"] == FRAMES * len(STARTS)
    assert set(facts["kinds"]) == {*KINDS, "genuine"}
    assert (facts["twice"], facts["strange"], facts["deaf"], facts["ended"]) == (0, 0, 0, [])
    assert facts["obeyed"] >= 10 * len(STARTS)
    refused = facts["refused"]
    assert min(refused[cause] for cause in ("CRC", "HEADER", "SPI", "MAC", "REPEATED", "BEYOND")) > 10


def test_a_gate_that_forgets_what_it_accepted_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    admit = Gate._admit

    def forgetful(self: Gate, frame: bytes) -> Any:
        before = dict(self._open)
        admitted = admit(self, frame)
        self._open.update(before)
        return admitted

    monkeypatch.setattr(Gate, "_admit", forgetful)
    found = run(FRAMES_CAMPAIGN.cases(1, SEED)[0])
    assert found["twice"] > 0
