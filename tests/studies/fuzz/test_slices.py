"""A small fixed slice of each fuzzing campaign, and proof that a campaign finds planted defects."""

from __future__ import annotations

import json
import time
from collections import Counter

import numpy as np
import pytest

from tests.studies.fuzz import harness
from tests.studies.fuzz.__main__ import TARGETS, main, target_of
from tests.studies.fuzz.harness import Finding, run
from tests.studies.fuzz.logs import collisions_allowed
from tests.studies.fuzz.vn100 import candidates
from tests.studies.fuzz.vn100_packets import checksum

SLICES = {
    "vn100": 250,
    "config": 40,
    "commands": 1500,
    "logs": 80,
    "link": 800,
    "cli": 60,
    "flown": 30,
    "files": 30,
    "releases": 60,
}
OTHERS = 250
"""Inputs of a target that reads little."""


@pytest.mark.parametrize("name", TARGETS)
def test_a_slice_of_the_campaign_finds_nothing(name: str) -> None:
    inputs = SLICES.get(name, OTHERS)
    campaign = run(name, target_of(name), inputs, seed=7)
    assert campaign.sound, campaign.findings
    assert campaign.inputs == inputs
    damaged = campaign.tallies["damaged"]
    assert campaign.tallies["collisions"] <= collisions_allowed(damaged)


def test_an_input_is_the_same_each_time() -> None:
    first, again = target_of("vn100"), target_of("vn100")
    run("vn100", first, 3, seed=5)
    run("vn100", again, 1, seed=5, first=2)
    assert first.last() == again.last()


class Faulty:
    """A target that fails in the way that the input's number says."""

    def __init__(self) -> None:
        self._number = -1

    def last(self) -> str:
        return str(self._number)

    def attempt(self, draw: np.random.Generator) -> Counter[str]:
        self._number += 1
        if self._number == 1:
            raise Finding("corruption was accepted")
        if self._number == 2:
            raise ZeroDivisionError
        while self._number == 3:
            pass
        while self._number == 4:
            time.sleep(1.0)
        return Counter(fine=1)


def test_accepted_corruption_a_crash_and_a_hang_are_each_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(harness, "LIMIT_S", 0.05)
    campaign = run("faulty", Faulty(), 6, seed=1)
    assert not campaign.sound
    assert [finding["input"] for finding in campaign.findings] == [1, 2, 3], "the first of each kind"
    kinds = [str(finding["kind"]).partition(" ")[0] for finding in campaign.findings]
    assert kinds == ["accepted:", "ZeroDivisionError", "hang"]
    assert sorted(campaign.distinct.values()) == [1, 1, 2], "an endless loop and a sleep"
    assert campaign.tallies["fine"] == 2, "the campaign goes on after each"


def test_a_parser_that_skips_the_checksum_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hal.drivers.vn100.protocol.crc16", lambda _: 0)
    assert not run("vn100", target_of("vn100"), 30, seed=7).sound


def test_a_gate_that_skips_the_mac_or_the_counter_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as forged:
        forged.setattr("flight.link.security.unprotect", lambda *parts: parts[-1][14:-16])
        assert not run("link", target_of("link"), 60, seed=7).sound
    monkeypatch.setattr("flight.link.security.counter_of", lambda _: 5)
    assert not run("link", target_of("link"), 60, seed=7).sound


def test_a_scanner_that_skips_the_checksum_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flight.link.telemetry.packets.crc16", lambda _: 0)
    assert not run("logs", target_of("logs"), 30, seed=7).sound


def test_a_reader_of_keys_that_skips_the_checksum_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flight.link.security.zlib.crc32", lambda _: 0)
    assert not run("keys", target_of("keys"), 60, seed=7).sound


def test_the_second_parsers_checksum_is_that_of_the_manual() -> None:
    assert checksum(b"123456789") == 0x31C3
    packet = bytes.fromhex("fa01080093502e42833ef13f48b504bb9288")  # UM001 v2.43, 4.3.7, example 1
    (found,) = candidates(b"\xfa\x01" + packet + b"\xfa")
    assert (found.start, found.stop) == (2, 20)


def test_the_command_prints_figures_as_json_and_its_status_says_whether_it_found_any(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["vn100", "--inputs", "20", "--seed", "3", "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert (output["inputs"], output["found"]) == (20, {})
