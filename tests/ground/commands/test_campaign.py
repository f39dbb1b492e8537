"""Tests of `knightcube campaign`: arguments, outputs, exit status and messages, without flights."""

from __future__ import annotations

import argparse
import json
import signal
from pathlib import Path
from typing import Any

import pytest

from ground.campaigns import CampaignError
from ground.campaigns.runner import Summary
from ground.commands import campaign
from knightcube.errors import UsageError


class Scripted:
    """Test double of a campaign of three flights, one of which is beyond a limit."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.flown: list[tuple[tuple[Any, ...], dict[str, Any]]] = []
        self.drawn: list[tuple[Any, Path]] = []
        self.error: BaseException | None = None
        self.is_interrupted = False
        self.picture: bool | UsageError = True
        self.facts = {"flights": 3, "within all limits": 2}
        monkeypatch.setattr("ground.campaigns.runner.fly", self.fly)
        monkeypatch.setattr("ground.campaigns.runner.results_in", lambda out: [out, "results"])
        monkeypatch.setattr("ground.campaigns.varied.draw_campaign", self.draw)

    def fly(self, *words: Any, **settings: Any) -> Summary:
        self.flown.append((words, settings))
        if self.is_interrupted:
            signal.raise_signal(signal.SIGINT)
        if self.error is not None:
            raise self.error
        return Summary("a table\n", self.facts)

    def draw(self, results: Any, file: Path) -> bool:
        self.drawn.append((results, file))
        if isinstance(self.picture, UsageError):
            raise self.picture
        return self.picture

    def run(self, *words: str) -> int:
        parser = argparse.ArgumentParser()
        campaign.configure(parser)
        return campaign.run(parser.parse_args(["step_demo", "--vary", "plant.inertia=5%", *words]))


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch) -> Scripted:
    return Scripted(monkeypatch)


def test_the_arguments_reach_the_campaign(scripted: Scripted) -> None:
    scripted.run(
        "--vary", "steps[1].q2=+-0.1", "--runs", "7", "--seed", "9", "--duration", "4.5", "--only", "x",
        "--out", "here", "--workers", "2", "--dask", "tcp://one",
    )  # fmt: skip
    ((made, runs, seed, out), settings) = scripted.flown[0]
    assert made.name.startswith("step_demo with plant.inertia=5%, steps[1].q2=+-0.1, 4.5 s (CRC")
    assert (runs, seed, out) == (7, 9, Path("here"))
    assert settings == {"progress": True, "workers": 2, "dask": "tcp://one", "only": "x"}
    assert scripted.drawn == [([Path("here"), "results"], Path("here/campaign.png"))]


def test_a_negative_seed_is_refused(scripted: Scripted, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        scripted.run("--seed", "-1")
    assert "give a whole number from 0" in capsys.readouterr().err


def test_the_defaults_are_a_hundred_flights_in_a_folder_named_after_the_configuration(
    scripted: Scripted,
) -> None:
    scripted.run()
    ((_, runs, seed, out), settings) = scripted.flown[0]
    assert (runs, seed, out) == (100, 1, Path("runs/campaigns/step_demo"))
    assert settings == {"progress": True, "workers": None, "dask": None, "only": ""}


def test_the_status_is_zero_only_if_every_flight_is_within_its_limits(
    scripted: Scripted, capsys: pytest.CaptureFixture[str]
) -> None:
    assert scripted.run("--out", "here") == 1
    assert capsys.readouterr().out == "a table\n\npicture: here/campaign.png\n"
    scripted.facts["within all limits"] = 3
    scripted.picture = False
    assert scripted.run("--out", "here") == 0
    assert capsys.readouterr().out == "a table\n"


def test_json_is_one_object_also_with_a_picture(
    scripted: Scripted, capsys: pytest.CaptureFixture[str]
) -> None:
    scripted.run("--json")
    assert json.loads(capsys.readouterr().out) == scripted.facts
    assert len(scripted.drawn) == 1


def test_a_picture_that_cannot_be_drawn_does_not_change_the_status(
    scripted: Scripted, capsys: pytest.CaptureFixture[str]
) -> None:
    scripted.picture = UsageError("pictures need matplotlib")
    assert scripted.run() == 1
    printed = capsys.readouterr()
    assert printed.err == "knightcube: not drawn: pictures need matplotlib\n"
    assert printed.out == "a table\n"


def test_an_interrupted_campaign_says_how_to_continue(
    scripted: Scripted, capsys: pytest.CaptureFixture[str]
) -> None:
    """The program `knightcube` ends by SIGINT at once unless a command handles the signal."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    scripted.is_interrupted = True
    try:
        assert scripted.run("--out", "here") == 130
    finally:
        signal.signal(signal.SIGINT, before)
    scripted.is_interrupted = False
    text = "interrupted; 2 results are kept; run the same command again to continue in here"
    assert capsys.readouterr().err == f"\n{text}\n"
    scripted.error = CampaignError("the scheduler is lost")
    text = "the scheduler is lost; run the same command again to continue in here"
    with pytest.raises(CampaignError, match=text):
        scripted.run("--out", "here")
    assert scripted.drawn == []
