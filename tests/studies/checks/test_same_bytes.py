"""Tests that the comparison of checkouts finds an injected difference and ignores permitted differences."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import asdict, astuple, replace
from pathlib import Path

import pytest

from flight.link.telemetry.definitions import EVENT, IMU, RUN, TARGET, Field, Packet
from flight.link.telemetry.packets import Packer, compile_layouts
from knightcube.errors import UsageError
from tests.studies.same_bytes.__main__ import main, run_all, table
from tests.studies.same_bytes.checkout import CheckoutError, check_out, resolve
from tests.studies.same_bytes.comparison import Texts, compare
from tests.studies.same_bytes.runs import (
    ANSWERS_FILE,
    FLIGHTS,
    PICTURES,
    TABLE_FILE,
    Run,
    ask,
    packet_table,
    photographs,
)

OLD = (RUN, IMU, TARGET)
RUN_VALUES: dict[str, object] = {
    **{
        "config_name": "synthetic",
        "config_crc": 1,
        "software": "1.0",
        "seed": 1,
        "utc_ns": 5,
        "simulated": 1,
    },
    **{"realtime": 0, "control_period_ns": 25_000_000, "duration": 1.0, "current_limit": 0.148},
    **{"coil_resistance": [23.0, 23.0, 23.0], "supply_voltage": 3.4},
}
IMU_VALUES: dict[str, object] = {
    **{"sample_time_ns": 0, "device_time_ns": 0, "quaternion": [0, 0, 0, 1], "rate": [0, 0, 1e-3]},
    **{"field": [0] * 3, "acceleration": [0] * 3},
}
EVENT_VALUES: dict[str, object] = {"code": 1, "severity": 0, "suppressed": 0, "name": "gap", "text": "x"}
Log = list[tuple[str, int, dict[str, object]]]
"""Packets of a log by name, with their times (ns) and values."""
PACKETS: Log = [
    ("run", 0, RUN_VALUES),
    *(("imu", cycle * 25_000_000, IMU_VALUES) for cycle in range(4)),
    ("target", 75_000_000, {"index": 0, "q2": -0.3, "rate": 0.0}),
]


def changed(place: int, **values: object) -> Log:
    """Return the packets, with some values of one packet changed."""
    name, time_ns, before = PACKETS[place]
    packets = list(PACKETS)
    packets[place] = name, time_ns, before | values
    return packets


def written(folder: Path, packets: Log, table: tuple[Packet, ...] = OLD) -> Path:
    """Write a flight log and its table."""
    packer, by_name = Packer(compile_layouts(table)), {packet.name: packet for packet in table}
    folder.mkdir(parents=True)
    data = [packer.pack(by_name[name], time_ns, values) for name, time_ns, values in packets]
    (folder / "flight-0001.ccsds").write_bytes(b"".join(data))
    (folder / TABLE_FILE).write_text(json.dumps([asdict(packet) for packet in table]))
    return folder


def event_logs(folder: Path, old: str, new: str) -> tuple[Path, Path]:
    """Write two logs of one event each: one with the old text, the other with the new text."""
    return (
        written(folder / "old", [("event", 0, EVENT_VALUES | {"text": old})], (EVENT,)),
        written(folder / "new", [("event", 0, EVENT_VALUES | {"text": new})], (EVENT,)),
    )


def answer_folders(folder: Path, old: object, new: object) -> tuple[Path, Path]:
    """Write two folders with the results of one command."""
    for name, answer in (("old", old), ("new", new)):
        (folder / name).mkdir(parents=True)
        (folder / name / ANSWERS_FILE).write_text(json.dumps({"solve it.png": answer}))
    return folder / "old", folder / "new"


def fake_checkout(folder: Path, main: str) -> Path:
    """Write a checkout in which `python -m flight` runs the given code, with the words in `arguments`."""
    (folder / "flight").mkdir(parents=True)
    (folder / "flight/__init__.py").touch()
    (folder / "flight/__main__.py").write_text(f"import json, sys\narguments = sys.argv[1:]\n{main}\n")
    return folder


APPENDED = Field("hold", "f8", "s", "time to hold")
LONGER = replace(TARGET, version=TARGET.version + 1, fields=(*TARGET.fields, APPENDED))
REWORDED = replace(RUN, meaning="other words", fields=tuple(replace(f, meaning="x") for f in RUN.fields))


@pytest.mark.parametrize(
    ("packets", "table", "added", "extended"),
    [
        (PACKETS, OLD, {}, 0),
        ([("event", 0, EVENT_VALUES), *PACKETS, ("event", 9, EVENT_VALUES)], (*OLD, EVENT), {"event": 2}, 0),
        (changed(0, utc_ns=6, software="2.0", config_crc=2), OLD, {}, 0),
        (changed(5, hold=3.0), (RUN, IMU, LONGER), {}, 1),
        (changed(0, utc_ns=9), (REWORDED, IMU, TARGET), {}, 0),
    ],
    ids=["equal", "new packets", "labels", "an appended field", "other meanings"],
)
def test_logs_are_equal_apart_from_labels_new_packets_and_appended_fields(
    tmp_path: Path, packets: Log, table: tuple[Packet, ...], added: dict[str, int], extended: int
) -> None:
    logs = written(tmp_path / "old", PACKETS), written(tmp_path / "new", packets, table)
    found = compare("synthetic", *logs, Texts())
    assert found.difference is None
    assert (found.compared, found.added, found.extended) == (6, added, extended)


@pytest.mark.parametrize(
    ("packets", "table", "expected"),
    [
        (changed(3, rate=[0, 0, 1e-3 + 2.0**-62]), OLD, ("imu", 0.05, "rate", "[2] 0.001")),
        ([*PACKETS[:4], PACKETS[5]], OLD, ("imu", 3 * 0.025, "packet", "imu", "target")),
        (PACKETS[:5], OLD, ("target", 3 * 0.025, "packet", "target", "end of log")),
        (changed(0, seed=2), OLD, ("run", 0.0, "seed", "1", "2")),
        (changed(5, q2=-0.31, hold=3.0), (RUN, IMU, LONGER), ("target", 3 * 0.025, "q2", "-0.3", "-0.31")),
    ],
    ids=["the last bit of a number", "a missing packet", "an early end", "no label", "a longer packet"],
)
def test_the_first_difference_of_logs_is_found(
    tmp_path: Path, packets: Log, table: tuple[Packet, ...], expected: tuple[object, ...]
) -> None:
    logs = written(tmp_path / "old", PACKETS), written(tmp_path / "new", packets, table)
    first = compare("synthetic", *logs, Texts()).difference
    assert first is not None
    assert (first.log, *astuple(first)[1 : 1 + len(expected)]) == ("flight", *expected)
    assert first.new != first.old


MOVED = Texts([{"old": "camera {n}: no {what}", "new": "no {what} from camera {n}"}])
LONG = "no frame " + "of the camera " * 12


@pytest.mark.parametrize(
    ("old", "new", "texts", "equal"),
    [
        ("camera 3: no frame", "no frame from camera 3", Texts(), False),
        ("camera 3: no frame", "no frame from camera 3", MOVED, True),
        ("camera 3: no frame", "no frame from camera 4", MOVED, False),
        ("camera 3: no frame", "camera 3: no frame", MOVED, True),
        ("no frame", LONG, Texts([{"old": "no frame", "new": LONG}]), True),
    ],
)
def test_texts_are_equal_if_the_table_renames_one_to_the_other_also_if_the_field_cuts_it(
    tmp_path: Path, old: str, new: str, texts: Texts, equal: bool
) -> None:
    first = compare("x", *event_logs(tmp_path, old, new), texts).difference
    assert (first is None) == equal
    if first is not None:
        assert (first.packet, first.field, first.old, first.new) == ("event", "text", repr(old), repr(new))


def test_renamed_texts_are_applied_in_their_order() -> None:
    texts = Texts([{"old": "a {x}", "new": "b {x}"}, {"old": "b {x}", "new": "c {x} of {x}"}])
    assert texts.renamed("a 1") == "c 1 of 1"
    assert texts.renamed("b (2)") == "c (2) of (2)"
    assert texts.renamed("d 1") == "d 1"


@pytest.mark.parametrize("pair", [{"old": "a"}, {"old": "a", "new": "b {x}"}, "a"])
def test_a_wrong_entry_of_the_table_is_refused(pair: dict[str, str]) -> None:
    with pytest.raises(UsageError, match="renamed text"):
        Texts([pair])


def test_the_committed_table_can_be_read() -> None:
    assert Texts.read().renamed("a text of nobody") == "a text of nobody"


ANSWER = {"status": 0, "output": {"status": "solved", "roll_deg": 20.5, "seconds": 0.1, "stars": [1, None]}}


@pytest.mark.parametrize(
    ("change", "field", "values"),
    [
        ({"roll_deg": 20.500000000000004}, "output.roll_deg", ("20.5", "20.500000000000004")),
        ({"stars": [1, 2]}, "output.stars.1", ("None", "2")),
        ({"stars": [1]}, "output.stars.length", ("2", "1")),
        ({"status": "resolved"}, "output.status", ("'solved'", "'resolved'")),
        ({"status": None}, "output.status", ("'solved'", "None")),
    ],
)
def test_a_changed_value_of_an_answer_is_found(
    tmp_path: Path, change: dict[str, object], field: str, values: tuple[str, str]
) -> None:
    new = {"status": 0, "output": {**ANSWER["output"], **change}}  # type: ignore[dict-item]  # it is a mapping
    first = compare("x", *answer_folders(tmp_path, ANSWER, new), Texts()).difference
    assert first is not None
    assert (first.log, first.packet, first.field) == ("answers", "solve it.png", field)
    assert (first.old, first.new) == values


def test_a_missing_key_of_an_answer_is_found_and_an_added_one_counted(tmp_path: Path) -> None:
    old, new = {"roll_deg": 1.0, "status": "solved"}, {"roll_deg": 1.0, "stars": 3}
    found = compare("x", *answer_folders(tmp_path, old, new), Texts())
    assert found.difference is not None
    assert (found.difference.field, found.difference.new) == ("status", "missing")
    assert found.added == {"key stars": 1}


def test_times_of_the_machine_make_no_difference(tmp_path: Path) -> None:
    new = {"status": 0, "output": {**ANSWER["output"], "seconds": 0.2}}  # type: ignore[dict-item]  # it is a mapping
    found = compare("x", *answer_folders(tmp_path, ANSWER, new), Texts())
    assert found.difference is None
    assert found.compared == 6


def test_the_table_of_renamed_texts_is_applied_to_answers(tmp_path: Path) -> None:
    old, new = (
        {"reason": "no star is seen", "error": ["a: b"]},
        {"why": "no star was found", "error": ["b of a"]},
    )
    folders = answer_folders(tmp_path, old, new)
    pairs = [
        {"old": "reason", "new": "why"},
        {"old": "no star is seen", "new": "no star was found"},
        {"old": "{x}: {y}", "new": "{y} of {x}"},
    ]
    assert compare("x", *folders, Texts(pairs)).difference is None
    for number in range(3):
        assert compare("x", *folders, Texts(pairs[:number] + pairs[number + 1 :])).difference is not None


def test_the_answers_of_a_checkout_are_recorded(tmp_path: Path) -> None:
    checkout = fake_checkout(
        tmp_path / "checkout",
        "if arguments[0] == 'wrong':\n    sys.stderr.write('flight: wrong\\n')\n    sys.exit(2)\n"
        "open('x.png', 'w').write('picture')\nprint(json.dumps(arguments))",
    )
    work = tmp_path / "work"
    work.mkdir()
    ask(checkout, Run("x", ("plan --to 'a b'", "wrong")), work)
    assert json.loads((work / ANSWERS_FILE).read_text()) == {
        "plan --to 'a b'": {"status": 0, "output": ["plan", "--to", "a b", "--json"], "error": []},
        "wrong": {"status": 2, "output": [], "error": ["flight: wrong"]},
        "x.png": hashlib.sha256(b"picture").hexdigest(),
    }


def test_photographs_are_asked_about_where_there_are_any(tmp_path: Path) -> None:
    assert photographs(tmp_path) is None
    (tmp_path / "sky").mkdir()
    for name in ("a.png", "README.md"):
        (tmp_path / "sky" / name).touch()
    assert photographs(tmp_path) == Run("photographs", ("solve photographs/sky/a.png",))


def test_a_run_that_fails_in_this_checkout_is_a_difference_and_the_others_are_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = "open('limb.png', 'w').write('x')\nprint(json.dumps(arguments))"
    old = fake_checkout(tmp_path / "old", good)
    new = fake_checkout(tmp_path / "new", f"if arguments[0] == 'plan':\n    raise KeyError('lost')\n{good}")
    monkeypatch.setattr("tests.studies.same_bytes.__main__.repository", lambda: new)
    monkeypatch.setattr(
        "tests.studies.same_bytes.__main__.check_out", lambda _, folder: shutil.copytree(old, folder)
    )
    runs = [Run("plan", ("plan",)), PICTURES]
    verdicts = run_all("0" * 40, runs, tmp_path / "keep", tmp_path / "cache", refresh=False)
    assert [verdict.difference is None for verdict in verdicts] == [False, True]
    assert "KeyError: 'lost'" in table("0" * 40, verdicts)


def test_the_flights_are_of_testbed_and_orbit() -> None:
    assert len(FLIGHTS) == 10
    assert {Path(run.flight.split()[0]).stem for run in FLIGHTS} == {
        *("step_demo", "step_thesis", "orbit", "orbit_3u", "orbit_object")
    }


def test_an_unknown_revision_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--against", "no-such-revision"]) == 2
    assert "same_bytes: git rev-parse" in capsys.readouterr().err


def test_the_packet_table_is_the_checkouts_own_in_the_old_layout_too(tmp_path: Path) -> None:
    """An editable installation of this project must not replace a module that the checkout lacks."""
    definitions = tmp_path / "flight/telemetry/definitions.py"
    definitions.parent.mkdir(parents=True)
    for folder in (tmp_path / "flight", definitions.parent):
        (folder / "__init__.py").touch()
    definitions.write_text(
        "from dataclasses import dataclass\n@dataclass\nclass P:\n    name: str\nPACKETS = (P('own'),)\n"
    )
    assert json.loads(packet_table(tmp_path)) == [{"name": "own"}]


@pytest.mark.slow
def test_a_short_flight_and_the_plans_of_the_last_commit_repeat_themselves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both compared checkouts are of HEAD, so uncommitted changes have no effect."""
    try:
        commit = resolve("HEAD")
    except CheckoutError as error:
        pytest.skip(f"not a git checkout: {error}")
    checkout = tmp_path / "checkout"
    check_out(commit, checkout)
    monkeypatch.setattr("tests.studies.same_bytes.__main__.repository", lambda: checkout)
    status = main(
        ["--against", "HEAD", "--only", "short", "plan", "--cache", str(tmp_path / "cache"), "--json"]
    )
    printed = json.loads(capsys.readouterr().out)
    assert [run["name"] for run in printed["runs"]] == ["short", "plan"]
    assert status == 0, printed
    assert printed["runs"][0]["compared"] > 900
    assert printed["runs"][1]["compared"] > 500
