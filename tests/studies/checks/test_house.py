"""The drawing of the house: found right in a small example, and within its limits in the project."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.studies.house import graph, sizes
from tests.studies.house.__main__ import draw, main

CONTRACT = """
[[tool.importlinter.contracts]]
name = "floors"
type = "layers"
layers = ["ground", "flight.app", "sim_hal | flight.loop", "hal"]
"""


def small_house(root: Path, **more: str) -> Path:
    """Write four rooms on three floors; `more` replaces or adds files, with __ for a slash."""
    sources = {
        "flight/__init__": "__version__ = '1'",
        "flight/__main__": "from flight.app import run",
        "flight/app/__init__": "",
        "flight/app/run": "from flight.loop.turn import turn\nimport hal.bus",
        "flight/loop/__init__": "",
        "flight/loop/turn": "from flight import __version__\ndef turn() -> int:\n    return 1",
        "ground/__init__": "",
        "ground/report": "def load():\n    from flight.app import run\n    return run",
        "hal/__init__": "",
        "hal/bus": "",
    } | {name.replace("__", "/"): text for name, text in more.items()}
    for name, text in sources.items():
        path = root / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")
    (root / "pyproject.toml").write_text(CONTRACT, encoding="utf-8")
    return root


def test_rooms_and_floors_follow_from_the_imports(tmp_path: Path) -> None:
    house = draw(small_house(tmp_path))
    assert house.floors == {"ground": 2, "flight.app": 1, "flight.loop": 0, "hal": 0}
    assert house.rooms["flight.app"] == {"flight.loop", "hal"}
    assert (house.back, house.circles) == ([], [])
    assert all(bar.met for bar in house.shape)


def test_an_import_against_the_floors_is_an_arrow_back_and_closes_a_circle(tmp_path: Path) -> None:
    house = draw(small_house(tmp_path, flight__loop__turn="def turn():\n    from ..app.run import x"))
    assert house.back == ["flight.loop.turn -> flight.app.run"]
    assert house.circles == [["flight.app", "flight.loop"], ["flight.app.run", "flight.loop.turn"]]
    assert [bar.met for bar in house.shape] == [True, True, False, False]


def test_siblings_on_one_floor_may_not_import_each_other(tmp_path: Path) -> None:
    house = draw(small_house(tmp_path, sim_hal__world="import flight.loop.turn"))
    assert house.back == ["sim_hal.world -> flight.loop.turn"]


def test_a_module_named_in_a_literal_import_module_counts(tmp_path: Path) -> None:
    text = "import importlib\nplan = importlib.import_module('flight.app.run')"
    assert draw(small_house(tmp_path, hal__late=text)).back == ["hal.late -> flight.app.run"]


def test_a_loose_module_in_flight_is_a_room_that_the_contract_must_name(tmp_path: Path) -> None:
    root = small_house(tmp_path, flight__loose="import hal.bus")
    assert "flight.loose" in graph.room_graph(graph.import_graph(graph.product_files(root)))
    with pytest.raises(ValueError, match=r"does not name flight\.loose"):
        draw(root)


def test_long_functions_and_classes_are_listed_unless_a_class_gives_its_reason(tmp_path: Path) -> None:
    body = "\n".join(f"        x = {i}" for i in range(55))
    wide = "\n".join(f"    a{i} = {i}" for i in range(360))
    reason = '    """Over 350 lines: a table."""\n'
    text = f"class A:\n    def long(self):\n{body}\nclass B:\n{wide}\nclass C:\n{reason}{wide}"
    measured = sizes.measure(graph.product_files(small_house(tmp_path, hal__long=text)))
    assert [piece.name for piece in measured.long_functions] == ["hal.long.A.long"]
    assert [piece.name for piece in measured.long_classes] == ["hal.long.B"]
    assert measured.files[0].name == "hal.long"


def test_the_house_has_its_rooms_and_floors_and_no_arrow_back() -> None:
    house = draw()
    missed = [str(bar) for bar in house.shape if not bar.met]
    assert not missed, "\n".join([*missed, *house.back, *map(str, house.circles)])


def test_files_classes_and_functions_keep_their_sizes() -> None:
    house = draw()
    missed = [str(bar) for bar in house.dimensions if not bar.met]
    pieces = [*house.sizes.long_classes, *house.sizes.long_functions]
    assert not missed, "\n".join([*missed, *map(str, pieces)])


def test_the_command_prints_one_object_and_its_status_says_whether_all_limits_are_met(
    capsys: pytest.CaptureFixture[str],
) -> None:
    status = main(["--json"])
    printed = json.loads(capsys.readouterr().out)
    assert status == int(not all(figure["met"] for figure in printed["figures"]))
    assert set(printed["floors"]) >= {"ground", "flight.app", "flight.loop", "hal", "sim_hal"}
