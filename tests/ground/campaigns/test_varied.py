"""Tests of runs with random values: distributions, refusals, resumption, and the table of failed runs."""

from __future__ import annotations

import json
import math
import shlex
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from flight.app.cli import main, to_json
from flight.link.commands import open_unix
from ground.campaigns import varied
from ground.campaigns.runner import Case, Result, fly
from ground.campaigns.varied import (
    draw_campaign,
    figures_of,
    fly_case,
    numbers_drawn,
    variation_of,
    varied_campaign,
)
from ground.report import figures
from hal.interfaces.errors import NotResponding
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
    "text", ["key", "key=", "key=5", "=5%", "key=5..1", "key=log 0..5", "k y=5%", "key=5..%", "key=-10%"]
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


@pytest.mark.parametrize(
    ("texts", "reason"),
    [
        (["guidance.cost=heat|foo"], r"such as guidance\.cost = foo: .*`guidance\.cost` is 'foo'"),
        (["coils.foo=1..2"], r"`coils\.foo` is an unknown key"),
        (["plant.inertia=5%", "plant.inertia=10%"], "plant.inertia: is given 2 times"),
        (["simulation.seed=1|2"], "each flight has its own seed"),
    ],
)
def test_variations_that_cannot_be_flown_are_refused(texts: list[str], reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        varied_campaign(DEMO, [variation_of(text) for text in texts], 10.0).cases(1, 1)


def test_the_refused_draws_of_a_case_are_counted() -> None:
    """A quarter of the uniform draws within +-200 % are refused, because an inertia is positive."""
    cases = varied_campaign(DEMO, [variation_of("plant.inertia=200%")], 10.0).cases(40, 1)
    refused = [case.parameters["refused"] for case in cases]
    assert 5 <= sum(refused) <= 40


def test_draws_that_are_always_refused_end_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(varied, "_DRAWS", 3)
    with pytest.raises(UsageError, match=r"each of 3 draws is refused, such as .*inertia"):
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
    rounded = json.loads(to_json([row["worst"] for row in judged]))
    assert rounded == [row["worst"] for row in report["thesis"]]
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


def test_a_campaign_flies_while_another_flight_uses_the_command_socket(tmp_path: Path) -> None:
    path = tmp_path / "commands"
    text = f"extends: {SIMULATION}\nname: mine\nduration: 0.5\nsteps: [{{at: 0.0, q2: 0.0}}]\ncamera: none\n"
    (tmp_path / "mine.yaml").write_text(f"{text}commands: {{socket: {path}}}\n", encoding="utf-8")
    campaign = varied_campaign(tmp_path / "mine.yaml", [variation_of("plant.inertia=1%")], None)
    (case,) = campaign.cases(1, 1)
    with closing(open_unix(path)):
        assert fly_case(case)["error"] == ""


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


# One flight of a campaign, with an artificial report.

CASE = Case("flight-00003", (1, 3), {"config": "name: x\n", "drawn": {"a": 1.0}, "duration": 5.0, "seed": 77})
ROW = {"worst": 1.0, "limit": 2.0, "unit": "deg", "verdict": "pass", "margin": 1.0}


class Flight:
    """Test double of a flight with a given report and a given end, which records the requests."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, verdict: str = "pass", *, interrupted: bool = False
    ) -> None:
        self.requests: list[Any] = []
        self.error: Exception | None = None
        self.flown = SimpleNamespace(
            interrupted=interrupted, ending=SimpleNamespace(mode="hold", faults={"imu-silent": 2})
        )
        thesis = ROW | {"quantity": "power", "verdict": verdict}
        report = {"requirements": [ROW | {"quantity": "pointing to target 3, rms"}], "thesis": [thesis]}
        monkeypatch.setattr(varied, "fly", self.fly)
        monkeypatch.setattr(varied, "read_run", lambda folder: folder)
        monkeypatch.setattr(varied, "summarise", lambda run: report)

    def fly(self, request: Any) -> Any:
        self.requests.append((request, request.config_path.read_text()))
        if self.error is not None:
            raise self.error
        return self.flown


def test_a_flight_keeps_its_drawn_values_and_its_limited_measures(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = Flight(monkeypatch)
    found = fly_case(CASE)
    judged = {"worst": 1.0, "limit": 2.0, "unit": "deg", "verdict": "pass"}
    assert found == {
        "key": "flight-00003",
        "drawn": {"a": 1.0},
        "judged": [{"quantity": "pointing, rms", **judged}, {"quantity": "power", **judged}],
        "error": "",
        "seed": 77,
        "duration": 5.0,
        "mode": "hold",
        "faults": {"imu-silent": 2},
    }
    ((request, text),) = flight.requests
    assert text == "name: x\n"
    assert (request.duration, request.seed, request.config_path.name) == (5.0, 77, "flight-00003.yaml")
    assert not request.config_path.exists(), "the folder of the flight is temporary"


def test_a_flight_beyond_a_limit_or_with_an_error_keeps_its_configuration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = Flight(monkeypatch, "miss")
    assert fly_case(CASE)["config"] == "name: x\n"
    flight.error = NotResponding("imu", "silent")
    found = fly_case(CASE)
    assert (found["error"], found["config"], found["judged"]) == (str(flight.error), "name: x\n", [])
    assert "mode" not in found

    def refused(request: Any) -> Any:
        raise UsageError(f"{request.config_path}:45: `coils.current_limit` is 5.0: must be 0.001 to 1 A")

    monkeypatch.setattr(varied, "fly", refused)
    assert fly_case(CASE)["error"].startswith("flight-00003.yaml:45: "), (
        "the kept file, not the temporary one"
    )
    Flight(monkeypatch, interrupted=True)
    with pytest.raises(KeyboardInterrupt):
        fly_case(CASE)


def test_the_worst_value_of_each_quantity_counts_and_missing_values_are_unknown() -> None:
    rows = [
        {"judged": [ROW | {"quantity": "a", "worst": 1.0}, ROW | {"quantity": "a", "worst": 3.0}]},
        {"judged": [ROW | {"quantity": "a", "worst": None}, ROW | {"quantity": "b", "worst": 5.0}]},
        {"judged": [ROW | {"quantity": "a", "worst": None}, ROW | {"quantity": "a", "worst": 2.0}]},
        {"judged": [ROW | {"quantity": "a", "worst": 4.0}, ROW | {"quantity": "a", "worst": None}]},
    ]
    found = figures_of(rows)
    assert list(found) == ["a", "b"]
    assert found["a"][:2] == (2.0, "deg")
    assert found["a"][2] == pytest.approx([3.0, math.nan, 2.0, 4.0], nan_ok=True)
    assert found["b"][2] == pytest.approx([math.nan, 5.0, math.nan, math.nan], nan_ok=True)
    drawn = [{"drawn": {"x": 1, "on": True, "name": "n"}}, {"drawn": {"x": 2.5, "on": False, "name": "m"}}]
    assert numbers_drawn(drawn) == {"x": [1.0, 2.5]}
    mixed = [{"drawn": {"x": 1, "y": value}} for value in (0.1, None)]  # such as --vary y=0.1|null
    assert numbers_drawn(mixed) == {"x": [1.0, 1.0]}


def test_the_printed_table_lists_twenty_failed_flights_and_the_facts_list_all(tmp_path: Path) -> None:
    campaign = varied_campaign(DEMO, [], None)
    found = campaign.summarise([result(k, 9.0) for k in range(23)], tmp_path)
    assert len(found.facts["failed flights"]) == 23
    assert "flight-00019" in found.text
    assert "flight-00020" not in found.text
    assert "further failed flights, in summary.json: 3" in found.text
    again = found.facts["failed flights"][4]["fly it again"]
    assert again == f"knightcube run {tmp_path / 'failed' / 'flight-00004'}.yaml --seed 4"
    timed = result(1, 9.0) | {"duration": 2.5}
    (row,) = campaign.summarise([timed], tmp_path).facts["failed flights"]
    assert row["fly it again"].endswith("--seed 1 --duration 2.5")
    good = campaign.summarise([result(k, 1.0) for k in range(3)], tmp_path / "good")
    assert "failed" not in good.text
    assert not (tmp_path / "good").exists()
    (figure,) = campaign.summarise([result(k, 1.0 * k) for k in range(1, 5)], tmp_path).facts["figures"]
    assert (figure["n"], figure["within"], figure["median"], figure["maximum"]) == (4, 4, 2.5, 4.0)
    assert figure["95 %"] == pytest.approx(3.85)


def test_the_picture_shows_each_measure_over_each_drawn_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[Any] = []
    monkeypatch.setattr(figures, "save", lambda figure, file: saved.append((figure, file)))
    results = [result(k, worst) for k, worst in enumerate((1.0, 40.0, 2.0, math.inf, None))]
    for k, one in enumerate(results):
        one["drawn"] = {"mass": float(k), "size": 10.0 * k, "name": "x"}
        one["judged"].append(
            {"quantity": "power", "worst": 0.5 * k, "limit": 9.0, "unit": "W", "verdict": "pass"}
        )
    assert draw_campaign(results, tmp_path / "x.png")
    ((figure, file),) = saved
    assert file == tmp_path / "x.png"
    axes = figure.axes
    assert len(axes) == 4
    good, beyond, infinite, limit = axes[0].get_lines()
    assert good.get_xydata().tolist() == [[0.0, 1.0], [2.0, 2.0]]
    assert beyond.get_xydata().tolist() == [[1.0, 40.0]]
    assert infinite.get_xydata().tolist() == [[3.0, 1.0]]
    assert limit.get_ydata()[0] == 4.0
    assert axes[1].get_lines()[0].get_xdata().tolist() == [0.0, 20.0]
    assert [ax.get_xlabel() for ax in axes] == ["", "", "mass", "size"]
    assert [ax.get_ylabel() for ax in axes] == ["error, deg", "", "power, W", ""]
    assert [ax.get_yscale() for ax in axes] == ["log", "log", "linear", "linear"]
    assert len(axes[2].get_lines()) == 3, "all powers are finite and within the limit"
    assert figure.get_size_inches() == pytest.approx([2.0 + 3.2 * 2, 0.8 + 2.4 * 2])


def test_the_strongest_influence_is_the_largest_rank_correlation(tmp_path: Path) -> None:
    """The ranks of x rise with the error, except for one exchanged pair, and the ranks of y fall."""
    results = [result(k, worst) for k, worst in enumerate((0.1, 0.2, 0.4, 0.8))]
    for one, x, y in zip(results, (1.0, 3.0, 2.0, 9.0), (5.0, 4.0, 3.0, -90.0), strict=True):
        one["drawn"] = {"x": x, "y": y}
    campaign = varied_campaign(DEMO, [], None)
    (row,) = campaign.summarise(results, tmp_path).facts["figures"]
    assert row["strongest influence"] == "y -1.00"
    for one in results:
        del one["drawn"]["y"]
    (row,) = campaign.summarise(results, tmp_path).facts["figures"]
    assert row["strongest influence"] == "x +0.80"  # Spearman: 1 - 6 * 2 / (4 * 15)
    (row,) = campaign.summarise(results[:2], tmp_path).facts["figures"]
    assert row["strongest influence"] == "-"


def test_equal_drawn_numbers_have_their_mean_rank(tmp_path: Path) -> None:
    """The ranks 1.5, 1.5, 3.5, 3.5 correlate with 1, 2, 3, 4 by 2 / sqrt(5) = 0.894."""
    results = [result(k, worst) for k, worst in enumerate((0.1, 0.2, 0.4, 0.8))]
    for one, x in zip(results, (7.0, 7.0, 8.0, 8.0), strict=True):
        one["drawn"] = {"same": 1.0, "x": x}
    campaign = varied_campaign(DEMO, [], None)
    (row,) = campaign.summarise(results, tmp_path).facts["figures"]
    assert row["strongest influence"] == "x +0.89"
    for one in results:
        del one["drawn"]["x"]
    (row,) = campaign.summarise(results, tmp_path).facts["figures"]
    assert row["strongest influence"] == "-"


def test_the_name_of_a_campaign_states_values_duration_and_checksum() -> None:
    long = varied_campaign(DEMO, [variation_of("plant.inertia=5%"), variation_of("steps[0].q2=1..2")], 2.5)
    assert long.name.startswith("step_demo with plant.inertia=5%, steps[0].q2=1..2, 2.5 s (CRC ")
    assert ", 2.5 s" not in varied_campaign(DEMO, [], None).name
    with pytest.raises(UsageError, match="has no section `simulation`"):
        varied_campaign(DEMO.with_name("testbed.yaml"), [], None)
