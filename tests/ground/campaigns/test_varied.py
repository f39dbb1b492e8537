"""Tests of runs with random values: distributions, refusals, resumption, and the table of failed runs."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flight.app.cli import main
from ground.campaigns import varied
from ground.campaigns.runner import Result, fly
from ground.campaigns.varied import draw_campaign, variation_of, varied_campaign
from knightcube.errors import UsageError

DEMO = Path(__file__).parents[3] / "config" / "step_demo.yaml"
ORBIT = DEMO.with_name("orbit_3u.yaml")
SIMULATION = DEMO.with_name("step_simulation.yaml")


def draws(text: str, value: float, count: int = 4000) -> np.ndarray[Any, Any]:
    """Return random values that a variation draws for a number of the configuration."""
    one, chance = variation_of(f"key={text}"), np.random.default_rng(5)
    return np.array([one.draw(chance, value) for _ in range(count)])


@pytest.mark.parametrize(
    ("text", "value", "low", "high"),
    [("10%", -4.0, -4.4, -3.6), ("+-0.5", 3.0, 2.5, 3.5), ("1..5", 99.0, 1.0, 5.0), ("-2..1e1", 0, -2, 10)],
)
def test_uniform_draws_fill_their_range(text: str, value: float, low: float, high: float) -> None:
    found = draws(text, value)
    assert low <= found.min() < low + 0.01 * (high - low)
    assert high - 0.01 * (high - low) < found.max() <= high
    assert found.mean() == pytest.approx(0.5 * (low + high), abs=0.02 * (high - low))


@pytest.mark.parametrize(("text", "value", "sigma"), [("normal 5%", 8.0, 0.4), ("normal 0.3", -8.0, 0.3)])
def test_normal_draws_have_their_standard_deviation(text: str, value: float, sigma: float) -> None:
    found = draws(text, value)
    assert found.mean() == pytest.approx(value, abs=4.0 * sigma / np.sqrt(len(found)))
    assert found.std() == pytest.approx(sigma, rel=0.05)


def test_logarithmic_draws_are_uniform_in_the_logarithm() -> None:
    found = draws("log 1..10000", 0.0)
    assert np.median(found) == pytest.approx(100.0, rel=0.2)
    assert found.min() >= 1.0
    assert found.max() <= 1e4


def test_a_choice_takes_each_value_as_yaml_reads_it() -> None:
    one, chance = variation_of("key=true| 2.5 |text"), np.random.default_rng(1)
    assert {one.draw(chance, 0.0) for _ in range(60)} == {True, 2.5, "text"}


@pytest.mark.parametrize(
    "text", ["key", "key=", "key=5", "=5%", "key=5..1", "key=log 0..5", "k y=5%", "key=5..%"]
)
def test_another_form_is_refused_with_all_forms(text: str) -> None:
    with pytest.raises(UsageError, match=r"--vary .*KEY=10%"):
        variation_of(text)


def cases(path: Path, *texts: str, runs: int = 5) -> list[dict[str, Any]]:
    """Return the parameters of the cases of a campaign."""
    campaign = varied_campaign(path, [variation_of(text) for text in texts], 1.0)
    return [case.parameters for case in campaign.cases(runs, 3)]


def test_each_number_of_a_list_is_drawn_and_the_rest_stays() -> None:
    base = yaml.safe_load(ORBIT.read_text())
    for given in cases(ORBIT, "craft.inertia=2%"):
        config = yaml.safe_load(given["config"])
        numbers = len(base["craft"]["inertia"])
        assert list(given["drawn"]) == [f"craft.inertia[{k}]" for k in range(numbers)]
        assert config["craft"].pop("inertia") == list(given["drawn"].values())
        ratios = np.array(list(given["drawn"].values())) / base["craft"]["inertia"]
        assert np.ptp(ratios) > 0.0
        np.testing.assert_allclose(ratios, 1.0, atol=0.02)
        assert config["coils"]["windings"] == base["coils"]["windings"]
        assert config["targets"] == base["targets"]


def test_one_element_of_a_list_is_drawn_by_its_index() -> None:
    base = yaml.safe_load(DEMO.read_text())
    for given in cases(DEMO, "steps[1].q2=+-0.1"):
        config = yaml.safe_load(given["config"])
        assert config["steps"][1]["q2"] == given["drawn"]["steps[1].q2"]
        assert config["steps"][1]["q2"] != base["steps"][1]["q2"]
        assert config["steps"][0] == base["steps"][0]


def test_values_of_an_extended_file_and_defaults_can_be_drawn() -> None:
    path = DEMO.with_name("orbit_object.yaml")  # this configuration extends orbit_3u.yaml
    for given in cases(path, "craft.mass=5%", "estimation.changed=0.1..0.2"):
        assert 0.1 <= yaml.safe_load(given["config"])["estimation"]["changed"] <= 0.2


def test_an_impossible_inertia_is_drawn_again() -> None:
    """A drawn inertia that violates the triangle inequality is drawn again.

    With a variation of 60 %, a third of the inertias of a slender body violate the inequality.
    """
    for given in cases(ORBIT, "craft.inertia=60%", runs=8):
        moments = np.sort(yaml.safe_load(given["config"])["craft"]["inertia"][:3])
        assert moments[2] <= moments[0] + moments[1]


def test_the_first_flights_do_not_depend_on_the_number_of_runs() -> None:
    assert cases(DEMO, "plant.inertia=10%", runs=3) == cases(DEMO, "plant.inertia=10%", runs=5)[:3]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("plant.inertai=5%", "inertia"),
        ("steps[99].q2=5%", "no value steps.99"),
        ("name=5%", "'step-demo' is not a number"),
        ("guidance=5%", "is not a number"),
        ("plant.inertia.x=5%", "no value plant.inertia.x"),
    ],
)
def test_a_key_that_holds_no_number_is_refused(text: str, reason: str) -> None:
    with pytest.raises(UsageError, match="--vary") as refused:
        varied_campaign(DEMO, [variation_of(text)], None)
    assert reason in str(refused.value)


def test_draws_that_are_always_refused_end_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(varied, "_DRAWS", 3)
    with pytest.raises(UsageError, match=r"3 draws in a row were refused, the last draw because .*inertia"):
        cases(DEMO, "plant.inertia=-2..-1")


@pytest.mark.slow
def test_a_campaign_continues_after_a_kill_with_the_same_result(tmp_path: Path) -> None:
    campaign = varied_campaign(SIMULATION, [variation_of("plant.inertia=20%")], 2.0)
    whole = fly(campaign, 3, 7, tmp_path / "whole", workers=1)
    lines = (tmp_path / "whole" / "results.jsonl").read_text().splitlines(keepends=True)
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "campaign.json").write_text((tmp_path / "whole" / "campaign.json").read_text())
    # The last line of the results is incomplete, as after a kill of the campaign.
    (broken / "results.jsonl").write_text(lines[1] + lines[0][:40])
    facts = json.loads(json.dumps(fly(campaign, 3, 7, broken, workers=1).facts).replace("broken", "whole"))
    assert facts == whole.facts
    again = varied_campaign(SIMULATION, [variation_of("plant.inertia=10%")], 2.0)
    with pytest.raises(UsageError, match="give another folder"):
        fly(again, 3, 7, broken, workers=1)


@pytest.mark.slow
def test_the_listed_command_flies_a_failed_flight_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command that the campaign prints for a failed flight reproduces the result of this flight.

    A run of 2 s is too short to meet the limit of the average power.
    """
    out = tmp_path / "campaign"
    vary = ["--vary", "simulation.release.rate=-0.3..-0.2"]
    words = ["campaign", str(SIMULATION), *vary, "--runs", "1", "--duration", "2", "--workers", "1"]
    assert main([*words, "--out", str(out), "--json"]) == 1
    (failed,) = json.loads(capsys.readouterr().out)["failed flights"]
    program, *again = shlex.split(failed["fly it again"])
    assert program == "knightcube"
    assert main([*again, "--out", str(tmp_path / "again"), "--json"]) == 0
    capsys.readouterr()
    assert main(["report", str(tmp_path / "again"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    judged = json.loads((out / "results.jsonl").read_text())["result"]["judged"]
    assert [row["worst"] for row in judged] == [row["worst"] for row in report["thesis"]]
    assert any(row["verdict"] == "miss" for row in judged)


@pytest.mark.slow
def test_an_interrupted_flight_has_no_result() -> None:
    """A SIGINT during a run, like Ctrl-C, ends the campaign without a result of this run."""
    code = (
        "import os, signal, sys, threading\n"
        "from pathlib import Path\n"
        "from ground.campaigns.varied import fly_case, varied_campaign, variation_of\n"
        "one = variation_of('plant.inertia=5%')\n"
        "(case,) = varied_campaign(Path(sys.argv[1]), [one], 600.0).cases(1, 1)\n"
        "threading.Timer(2.0, os.kill, [os.getpid(), signal.SIGINT]).start()\n"
        "try:\n    fly_case(case)\nexcept KeyboardInterrupt:\n    print('interrupted')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(SIMULATION)],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.stdout == "interrupted\n", done.stderr


def result(number: int, worst: float | None, error: str = "") -> Result:
    """Return an artificial result of a run."""
    verdict = "miss" if worst is None or worst > 4.0 else "pass"
    judged = [{"quantity": "error", "worst": worst, "limit": 4.0, "unit": "deg", "verdict": verdict}]
    return {
        "key": f"flight-{number:05d}",
        "drawn": {"craft.mass": float(number), "name": "x"},
        "judged": [] if error else judged,
        "error": error,
        "seed": number,
        "duration": None,
        "config": "name: x\n",
    }


def test_the_table_states_limits_quantiles_and_the_strongest_influence(tmp_path: Path) -> None:
    campaign = varied_campaign(DEMO, [], None)
    results = [result(k, 0.5 * k) for k in range(10)] + [result(10, None), result(11, 1.0, "device lost")]
    found = campaign.summarise(results, tmp_path).facts
    assert (found["flights"], found["within all limits"]) == (12, 9)
    (row,) = found["figures"]
    assert (row["n"], row["within"], row["median"], row["maximum"]) == (10, 9, 2.25, 4.5)
    assert row["strongest influence"] == "craft.mass +1.00"
    assert [one["why"] for one in found["failed flights"]] == [
        "error 4.5 deg (limit 4)",
        "error none (limit 4)",
        "device lost",
    ]
    assert (tmp_path / "failed" / "flight-00010.yaml").read_text() == "name: x\n"


def test_the_picture_needs_a_drawn_number(tmp_path: Path) -> None:
    results = [result(k, 0.5 * k) for k in range(10)]
    assert draw_campaign(results, tmp_path / "campaign.png")
    assert (tmp_path / "campaign.png").stat().st_size > 5000
    for one in results:
        one["drawn"] = {"name": "x"}
    assert not draw_campaign(results, tmp_path / "none.png")


def test_the_temporary_files_of_a_campaign_killed_after_its_last_result_are_deleted(tmp_path: Path) -> None:
    campaign = varied_campaign(DEMO, [variation_of("plant.inertia=10%")], 0.1)
    fly(campaign, 1, 1, tmp_path / "out", workers=1)
    left = tmp_path / "knightcube-campaign-left"
    left.mkdir()
    (tmp_path / "out" / "temporary").symlink_to(left)
    fly(campaign, 1, 1, tmp_path / "out", workers=1)
    assert not left.exists()
    assert not (tmp_path / "out" / "temporary").is_symlink()
