"""Tests of commands, parameters and files of a satellite, with test doubles of socket and link."""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from flight.link.commands import ChangeMode, Ping, Point, Slew, command_of_words, crc_of, unpack
from flight.link.events import Mode
from flight.link.files.store import Store
from flight.link.files.transfer import Progress
from flight.link.process import directives
from flight.link.process.commanding import Report, Request, Stage
from flight.link.process.directives import (
    CancelFile,
    DeleteFile,
    Deletion,
    Directive,
    ListFiles,
    Listing,
    Play,
    Restart,
    ResumeFile,
    Scheduled,
    Stop,
    SuspendFile,
)
from flight.link.process.downlink import LIVE, PLAYBACK
from flight.link.process.filing import LISTING
from flight.link.telemetry.definitions import (
    COMMAND,
    PARAMETER_FIELDS,
    PARAMETER_KEYS,
    PARAMETERS,
    VERIFICATION,
    Packet,
)
from flight.link.telemetry.packets import Packer
from ground.commands import satellite
from ground.link.commanding import FileSession
from knightcube.errors import KnightCubeError, UsageError
from knightcube.gnc.guidance.pointing_target import Goal
from tests.ground.commands.in_process import command

DEFAULTS = {
    key: (0.5 * (field.valid[0] + min(field.valid[1], field.valid[0] + 1.0)) if field.valid else 0.0)
    for key, field in zip(PARAMETER_KEYS, PARAMETER_FIELDS, strict=True)
}


def packed(packet: Packet, **values: Any) -> bytes:
    """Return a packet whose values are zero or empty, except for the given values."""
    plain: dict[str, Any] = {}
    for field in packet.fields:
        zero: Any = "" if field.kind.startswith("S") else 0
        plain[field.name] = [zero] * field.count if field.count > 1 else zero
    return Packer().pack(packet, 0, {**plain, **values})


def answer(obeyed: bool, mode: Mode = Mode.HOLD, text: str = "done") -> bytes:
    """Return the reply of a flight to a command."""
    return packed(COMMAND, obeyed=int(obeyed), mode=int(mode), text=text, count=4)


def table(values: dict[str, float], **changes: Any) -> bytes:
    """Return a packet of parameters."""
    numbers = [values[key] for key in PARAMETER_KEYS]
    fields = {field.name: value for field, value in zip(PARAMETER_FIELDS, numbers, strict=True)}
    known = {"crc": crc_of(numbers), "loads": 2, "table": 1, "kept": 1}
    return packed(PARAMETERS, **{**known, **fields, **changes})


class Flight:
    """A test double of a flight process, which answers from a list and stores the received commands."""

    def __init__(self, *answers: bytes) -> None:
        self.answers = list(answers)
        self.packets: list[bytes] = []

    def exchange(self, to: str, data: bytes, timeout: float) -> bytes:
        self.packets.append(data)
        return self.answers.pop(0)


@pytest.fixture
def flight(monkeypatch: pytest.MonkeyPatch) -> Flight:
    """Return a test double that receives the commands instead of a socket."""
    found = Flight()
    monkeypatch.setattr(satellite, "exchange", found.exchange)
    return found


@pytest.mark.parametrize(
    ("obeyed", "status", "line"),
    [(True, 0, "executed: done; mode hold\n"), (False, 1, "refused: done; mode hold\n")],
)
def test_a_command_is_sent_and_its_answer_printed(
    flight: Flight, obeyed: bool, status: int, line: str
) -> None:
    flight.answers = [answer(obeyed)] * 2
    done = command("command", "--to", "socket", "slew", "0.2")
    assert (done.returncode, done.stdout) == (status, line)
    assert unpack(flight.packets[-1]) == Slew(0.2)
    facts = json.loads(command("command", "--to", "socket", "--json", "mode", "hold").stdout)
    assert facts == {"obeyed": obeyed, "mode": "hold", "text": "done", "count": 4}


def test_an_invalid_answer_is_an_error(flight: Flight) -> None:
    flight.answers = [b"xyz"]
    done = command("command", "--to", "socket", "ping")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "3 bytes" in done.stderr


def test_directives_of_the_link_need_the_link(flight: Flight) -> None:
    done = command("command", "--to", "socket", "stop-playback")
    assert done.returncode == 2
    assert "--link" in done.stderr
    assert flight.packets == []


def words(*arguments: str) -> Any:
    """Return the parsed options of a command line."""
    parser = argparse.ArgumentParser()
    satellite.configure_command(parser)
    return parser.parse_args(["--to", "socket", *arguments])


@pytest.mark.parametrize(
    ("arguments", "directive"),
    [
        (("play", "1.5", "9", "--run", "3"), Play(3, 1.5, 9.0)),
        (("stop-playback",), Stop()),
        (("unschedule", "7"), Deletion(7)),
        (("restart", "link"), Restart(1)),
        (("list-schedule",), Listing()),
    ],
)
def test_the_directives_are_packed_as_typed(arguments: tuple[str, ...], directive: Any) -> None:
    assert directives.unpack(satellite.packet_of(words(*arguments))) == directive


@pytest.mark.parametrize(
    "typed",
    [
        "slew -0.2",
        "point ground 52.5 13.25 --roll -45",
        "point inertial 0.6 0 0 -0.8",
        "point nadir",
        "point sun --roll 90",
        "mode hold",
        "clear coil-broken",
        "safe end",
        "ping",
        "dump-parameters",
    ],
)
def test_a_scheduled_command_is_the_command_as_typed(typed: str) -> None:
    options = satellite._with_scheduled(words("schedule", "2026-11-23T21:00:00", *typed.split(), "--json"))
    directive = directives.unpack(satellite.packet_of(options))
    assert isinstance(directive, Scheduled)
    assert options.json
    flown, meant = command_of_words(directive.words), satellite._command_of(words(*typed.split()))
    if isinstance(meant, Point):
        assert isinstance(flown, Point)
        assert flown.target.goal is meant.target.goal
        assert flown.target.roll == pytest.approx(meant.target.roll, abs=1e-9)
        assert flown.target.numbers == pytest.approx(meant.target.numbers, abs=1e-9)
    else:
        assert flown == meant


@pytest.mark.parametrize(
    ("typed", "complaint"),
    [
        (("--timeout", "0", "ping"), "--timeout 0.0: must be a positive number of seconds"),
        (("--timeout", "nan", "ping"), "--timeout nan: must be a positive number of seconds"),
        (("schedule", "tomorrow", "mode", "safe"), "'tomorrow' is not a UTC such as"),
        (("schedule", "2026-11-23", "mode", "safe"), "'2026-11-23' is not a UTC such as"),
        (("play", "nan", "5"), "playback from nan to 5 s: give two numbers"),
        (("play", "10", "5"), "the end 5 s must not be before the begin 10 s"),
        (("unschedule", "-1"), "number = -1 cannot be stored as u4"),
        (("point", "ground", "10", "400"), "longitude 400 deg must lie within -360 to 360 deg"),
    ],
)
def test_a_wrong_command_is_refused_before_it_is_sent(
    monkeypatch: pytest.MonkeyPatch, typed: tuple[str, ...], complaint: str
) -> None:
    monkeypatch.setattr(satellite, "send", lambda *_: pytest.fail("a frame was sent"))
    monkeypatch.setattr(satellite, "terminal_of", lambda _: Link())
    done = command("command", *LINK, *typed)
    assert (done.returncode, complaint in done.stderr) == (2, True), done.stderr


def test_a_reason_that_is_too_long_is_cut_with_a_warning(capsys: pytest.CaptureFixture[str]) -> None:
    made = unpack(satellite.packet_of(words("safe", "x" * 70)))
    assert made == ChangeMode(Mode.SAFE, "x" * 63)
    assert "reason: only its first 63 bytes are sent" in capsys.readouterr().err


def test_a_table_of_parameters_cannot_be_scheduled(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        satellite._with_scheduled(words("schedule", "2026-11-23T21:00:00", "load-parameters", "1", "2"))
    assert "knightcube command schedule UTC: error: argument WHAT" in capsys.readouterr().err


def test_the_optional_numbers_of_a_goal_are_not_named_as_missing(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        words("point")
    assert capsys.readouterr().err.endswith("the following arguments are required: goal\n")
    made = satellite._command_of(words("point", "sun"))
    assert isinstance(made, Point)
    assert made.target.numbers == ()


def test_options_may_follow_the_command() -> None:
    assert words("slew", "0.2", "--json", "--timeout", "7").timeout == 7.0
    assert words("slew", "0.2").timeout == 2.0


def test_angles_are_typed_in_degrees_and_quaternions_as_they_are() -> None:
    made = satellite._command_of(words("point", "ground", "30", "60", "--roll", "90"))
    assert isinstance(made, Point)
    target = made.target
    assert target.goal is Goal.GROUND
    assert target.roll == pytest.approx(0.5 * math.pi)
    assert target.numbers == pytest.approx((math.pi / 6.0, math.pi / 3.0))
    made = satellite._command_of(words("point", "inertial", "0.6", "0", "0", "0.8"))
    assert isinstance(made, Point)
    assert (made.target.numbers, made.target.roll) == ((0.6, 0.0, 0.0, 0.8), None)
    assert isinstance(satellite._command_of(words("ping")), Ping)
    assert satellite._command_of(words("mode", "hold")) == ChangeMode(Mode.HOLD)


def report(stage: Stage, text: str = "text", counter: int = 1, spi: int = 1) -> Report:
    """Return a report on a command."""
    return Report(spi, counter, stage, "ping", text, Request(0, 0))


class Link:
    """A ground terminal whose telemetry is a list."""

    packet_bytes = 987
    channel = LIVE

    def __init__(self, *packets: bytes) -> None:
        self.received = list(packets)
        self.sent: list[bytes] = []
        self.closed = 0
        self.gate = SimpleNamespace(admitted=0, refused=Counter())

    def send(self, packet: bytes, spi: int = 1) -> int:
        self.sent.append(packet)
        return len(self.sent)

    def packets(self, seconds: float) -> Iterator[tuple[int, bytes]]:
        while self.received:
            yield self.channel, self.received.pop(0)

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def link(monkeypatch: pytest.MonkeyPatch) -> Link:
    """Return a test double of the terminal, which the commands use instead of a link."""
    found = Link()
    monkeypatch.setattr(satellite, "terminal_of", lambda _: found)
    return found


LINK = ("--link", "127.0.0.1:9", "--keys", "keys")


@pytest.mark.parametrize(("last", "status"), [(Stage.COMPLETED, 0), (Stage.FAILED, 1)])
def test_each_stage_of_a_command_by_the_link_is_printed(
    link: Link, monkeypatch: pytest.MonkeyPatch, last: Stage, status: int
) -> None:
    reports = [report(Stage.ACCEPTED, "a"), report(last, "b", counter=8)]

    def send(_terminal: Any, _packet: bytes, spi: int, seconds: float, show: Any) -> list[Report]:
        assert (spi, seconds) == (2, 3.0)
        for one in reports:
            show(one)
        return reports

    monkeypatch.setattr(satellite, "send", send)
    options = ("--spi", "2", "--timeout", "3")
    done = command("command", *LINK, *options, "ping")
    assert (done.returncode, done.stdout) == (status, f"accepted: a\n{last.name.lower()}: b\n")
    facts = json.loads(command("command", *LINK, *options, "--json", "ping").stdout)
    assert facts == {
        "obeyed": status == 0,
        "counter": 8,
        "stages": [{"stage": "accepted", "text": "a"}, {"stage": last.name.lower(), "text": "b"}],
    }
    assert link.closed == 2


@pytest.mark.parametrize(
    ("words", "mode"),
    [(("mode", "point"), "point"), (("slew", "0.2"), "hold"), (("point", "nadir"), "point"), (("ping",), "")],
)
def test_a_command_that_has_only_started_says_how_to_see_its_completion(
    link: Link, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], mode: str
) -> None:
    monkeypatch.setattr(satellite, "send", lambda *_: [report(Stage.STARTED, "b")])
    done = command("command", *LINK, *words)
    watch = "`knightcube watch --link 127.0.0.1:9 --keys keys --once` shows the mode"
    expected = f"complete when the flight enters the mode {mode}: {watch}\n" if mode else ""
    assert (done.returncode, done.stdout) == (0, expected)


def test_the_table_of_parameters_is_shown_with_its_bounds(flight: Flight) -> None:
    flight.answers = [answer(True) + table(DEFAULTS)] * 2
    done = command("parameters", "--to", "socket")
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    assert len(lines) == len(PARAMETER_KEYS) + 1
    first, field = lines[0].split(), PARAMETER_FIELDS[0]
    assert field.valid is not None
    assert first == [PARAMETER_KEYS[0], f"{DEFAULTS[PARAMETER_KEYS[0]]:g}", field.unit,
                     f"{field.valid[0]:g}", "to", f"{field.valid[1]:g}"]  # fmt: skip
    crc = crc_of([DEFAULTS[key] for key in PARAMETER_KEYS])
    assert f"table {crc:08x}" in lines[-1]
    assert "(number of loads: 2)" in lines[-1]
    facts = json.loads(command("parameters", "--to", "socket", "--json").stdout)
    assert (facts["crc"], facts["loads"], facts["kept"], facts["refused"]) == (f"{crc:08x}", 2, True, "")
    assert facts["values"] == pytest.approx(DEFAULTS)


def test_a_changed_table_is_sent_whole_and_checked(flight: Flight, tmp_path: Path) -> None:
    key, other = PARAMETER_KEYS[3], {**DEFAULTS, PARAMETER_KEYS[3]: 77.0}
    flight.answers = [answer(True) + table(DEFAULTS), answer(True), answer(True) + table(other, kept=0)]
    done = command("parameters", "--to", "socket", f"{key}=77", "--save", tmp_path / "t.yaml")
    assert (done.returncode, len(flight.packets)) == (0, 3)
    (line,) = [line for line in done.stdout.splitlines() if line.startswith(key)]
    assert line.endswith(f"was {DEFAULTS[key]:g}")
    assert "not kept" in done.stdout
    flight.answers = [answer(True) + table(DEFAULTS), answer(True), answer(True) + table(other)]
    again = command("parameters", "--to", "socket", "--load", tmp_path / "t.yaml")
    assert again.returncode == 0
    assert f"was {DEFAULTS[key]:g}" in again.stdout
    flight.answers = [answer(True) + table(other)]
    same = command("parameters", "--to", "socket", f"{key}=77")
    assert (same.returncode, flight.answers) == (0, []), "nothing is sent for the table in use"


def test_a_refused_table_is_reported(flight: Flight) -> None:
    flight.answers = [answer(True) + table(DEFAULTS), answer(False, text="too late")]
    done = command("parameters", "--to", "socket", f"{PARAMETER_KEYS[3]}=77")
    assert done.returncode == 1
    assert "too late" in done.stderr
    flight.answers = [answer(True) + table(DEFAULTS), answer(True), answer(True) + table(DEFAULTS)]
    done = command("parameters", "--to", "socket", f"{PARAMETER_KEYS[3]}=77")
    assert done.returncode == 1, "another table is in use"
    flight.answers = [answer(True)]
    assert command("parameters", "--to", "socket").returncode == 1, "no table was sent"


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("modes.nothing=1",), "modes.nothing"),
        ((f"{PARAMETER_KEYS[0]}=much",), "much"),
        (("--timeout", "0"), "--timeout"),
        ((f"{PARAMETER_KEYS[0]}=1e9",), PARAMETER_KEYS[0]),
        (
            ("health.temperature=100", "health.hottest=50"),
            "health.temperature = 100 must not exceed health.hottest = 50 degree C",
        ),
    ],
)
def test_wrong_parameters_are_refused(flight: Flight, arguments: tuple[str, ...], complaint: str) -> None:
    flight.answers = [answer(True) + table(DEFAULTS)]
    done = command("parameters", "--to", "socket", *arguments)
    assert done.returncode == 2
    assert complaint in done.stderr


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("modes: 3\n", "modes"),
        ("modes: {slew_limit: yes}\n", "slew_limit"),
        ("modes: {slew_limit: 5}\n", "missing"),
    ],
)
def test_a_file_of_parameters_is_checked(tmp_path: Path, text: str, complaint: str) -> None:
    (tmp_path / "t.yaml").write_text(text)
    done = command("parameters", "--to", "socket", "--load", tmp_path / "t.yaml")
    assert done.returncode == 2
    assert complaint in done.stderr


def verified(stage: Stage, counter: int = 1, spi: int = 1, text: str = "why") -> bytes:
    """Return a verification packet."""
    return packed(VERIFICATION, stage=int(stage), counter=counter, spi=spi, text=text)


def by_link(options: Any, wants_table: bool = True) -> Any:
    """Return the telemetry that a request receives over the link."""
    return satellite._ask_by_link(options, b"packet", wants_table)


def test_the_table_arrives_before_or_after_its_verification(link: Link) -> None:
    options = SimpleNamespace(spi=1, timeout=0.5, link="here")
    for packets in (
        [verified(Stage.ACCEPTED), table(DEFAULTS), verified(Stage.COMPLETED)],
        [verified(Stage.COMPLETED), table(DEFAULTS)],
    ):
        link.received, link.sent = list(packets), []
        found, refused = by_link(options)
        assert (found.crc, refused, link.received) == (
            crc_of([DEFAULTS[key] for key in PARAMETER_KEYS]),
            "",
            [],
        )
    link.received, link.sent = [verified(Stage.COMPLETED), table(DEFAULTS)], []
    assert by_link(options, wants_table=False) == (None, "")
    assert len(link.received) == 1, "a load needs no table"
    link.received, link.sent = [verified(Stage.FAILED), table(DEFAULTS)], []
    assert by_link(options) == (None, "why")
    for other in ([], [verified(Stage.COMPLETED, counter=2)], [verified(Stage.COMPLETED, spi=2)]):
        link.received, link.sent = list(other), []
        with pytest.raises(KnightCubeError, match=r"within 0\.5 s"):
            by_link(options)


def test_an_old_table_of_a_playback_is_not_the_table_in_use(link: Link) -> None:
    options = SimpleNamespace(spi=1, timeout=0.5, link="here")
    link.channel = PLAYBACK
    link.received, link.sent = [table(DEFAULTS), verified(Stage.COMPLETED)], []
    assert by_link(options) == (None, "")


class Session:
    """A file session with given reports and results for each cycle."""

    ended, completed, received_file = FileSession.ended, FileSession.completed, FileSession.received_file

    def __init__(self, folder: Path, *turns: tuple[list[Report], list[Any]]) -> None:
        self.received = folder
        self.received_ns = 10**30
        self.turns = list(turns)
        self.asked: list[Any] = []
        self._reports: list[Report] = []
        self.entity = SimpleNamespace(ended=[], transfers=list)
        self._failed: list[Any] = []
        self._credit_ns = 0
        self._texts = {(one.source, one.number): "no room" for _, ended in turns for one in ended}

    def ask(self, directive: Any, _: int) -> None:
        self.asked.append(directive)

    def put(self, path: Path, name: str, _: int) -> Any:
        return SimpleNamespace(number=5, size=path.stat().st_size, name=name)

    def transmit(self, _: int) -> None:
        reports, ended = self.turns.pop(0)
        self._reports += reports
        self.entity.ended += ended

    def take(self, *_: Any) -> None:
        """Do nothing, because no telemetry arrives."""

    def reports(self) -> list[Report]:
        found, self._reports = self._reports, []
        return found

    def reason_of(self, _: Any) -> str:
        return "no room"


@pytest.fixture
def quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the link silent without real waiting."""
    monkeypatch.setattr("ground.commands.satellite.select.select", lambda *_: ([], [], []))


def work(session: Session, ended: bool = False) -> satellite._FileWork:
    """Return the file-transfer methods for a session."""
    return satellite._FileWork(cast(Any, session), cast(Any, None), 1e9, lambda: ended)


def ending(name: str, number: int = 5, condition: int = 0) -> Any:
    """Return the packet that reports the end of a transfer."""
    return SimpleNamespace(name=name, source=2, number=number, condition=condition)


@pytest.mark.usefixtures("quiet")
@pytest.mark.parametrize("failing", [5.0, 50.0])
def test_a_network_that_fails_is_reported_once_and_ends_a_transfer_only_if_it_lasts(
    tmp_path: Path, failing: float, capsys: pytest.CaptureFixture[str]
) -> None:
    class Unreachable(Session):
        def transmit(self, _: int) -> None:
            if len(self.turns) > 1:
                self.turns.pop(0)
                raise KnightCubeError("192.0.2.7:5010: cannot be reached: Network is unreachable")
            super().transmit(_)

    path = tmp_path / "tle.txt"
    path.write_bytes(b"x")
    session = Unreachable(tmp_path, *[([], [])] * 4, ([], [ending("elements/tle.txt")]))
    terminal = SimpleNamespace(failing=failing)
    work = satellite._FileWork(cast(Any, session), cast(Any, terminal), 10.0, lambda: False)
    options = argparse.Namespace(what="put", kind="elements", path=path, replace=False)
    if failing > 10.0:
        with pytest.raises(KnightCubeError, match="unreachable"):
            work.obey(options)
        return
    assert work.obey(options)["bytes"] == 1
    assert capsys.readouterr().err.count("Network is unreachable") == 1


@pytest.mark.usefixtures("quiet")
def test_the_name_that_a_satellite_gives_a_file_does_not_control_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Control characters in file names of the satellite are not printed.

    A refused transfer keeps its file name until it is closed, but the command prints only its own transfer.
    """
    (tmp_path / "up").write_bytes(b"x")
    session = Session(tmp_path, ([], []), ([], [ending("elements/up")]))
    names = ("\x1b]0;x\x07", "", "elements/earlier")
    session.entity.transfers = lambda: [SimpleNamespace(name=name, done=0, size=9) for name in names]
    options = cast(Any, SimpleNamespace(what="put", path=tmp_path / "up", kind="elements", replace=False))
    work(session).obey(options)
    said = capsys.readouterr().err
    assert said == "knightcube: elements/up: 0 of 9 bytes\n"


@pytest.mark.usefixtures("quiet")
def test_files_are_got_put_and_listed(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    session = Session(tmp_path, ([report(Stage.STARTED)], []), ([], [ending("b"), ending("a")]))
    found = work(session).obey(cast(Any, SimpleNamespace(what="get", names=["a"])))
    assert (found["files"][0]["name"], found["files"][0]["bytes"]) == ("a", 3)
    done = Session(tmp_path, ([report(Stage.COMPLETED)], []))
    work(done).obey(cast(Any, SimpleNamespace(what="get", names=["a"])))
    assert done.turns == [], "a completed command is the end too"
    listing = LISTING
    (tmp_path / listing).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / listing).write_text('{"free": 9, "files": []}')
    listed = work(Session(tmp_path, ([], [ending(listing)]))).obey(
        cast(Any, SimpleNamespace(what="list", under="x"))
    )
    assert listed["free"] == 9
    assert "9 bytes" in listed["text"]
    put = Session(tmp_path, ([], [ending("index/a", 4)]), ([], [ending("index/a")]))
    options = SimpleNamespace(what="put", kind="index", path=tmp_path / "a", replace=False)
    facts = work(put).obey(cast(Any, options))
    assert (facts["name"], facts["bytes"], put.turns) == ("received/index/a", 3, [])


@pytest.mark.usefixtures("quiet")
@pytest.mark.parametrize("on_board", [True, False])
def test_a_file_on_board_is_deleted_before_it_is_replaced(tmp_path: Path, on_board: bool) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    files = [{"name": name} for name in ("received/index/ab", "received/index/a")[: 1 + on_board]]
    (tmp_path / LISTING).write_text(json.dumps({"free": 9, "files": files}))
    answer = ([report(Stage.COMPLETED)], list[Progress]())
    answers = [answer] if on_board else []
    session = Session(tmp_path, ([], [ending(LISTING)]), *answers, ([], [ending("index/a")]))
    options = SimpleNamespace(what="put", kind="index", path=tmp_path / "a", replace=True)
    work(session).obey(cast(Any, options))
    name = "received/index/a"
    assert session.asked == [ListFiles(name), *[DeleteFile(name)][: int(on_board)]]
    assert session.turns == []


@pytest.mark.usefixtures("quiet")
def test_a_failed_transfer_is_an_error_with_its_reason(tmp_path: Path) -> None:
    options = cast(Any, SimpleNamespace(what="get", names=["a"]))
    with pytest.raises(KnightCubeError, match="a: no room"):
        work(Session(tmp_path, ([], [ending("a", condition=4)]))).obey(options)
    with pytest.raises(KnightCubeError, match="text"):
        work(Session(tmp_path, ([report(Stage.FAILED)], []))).obey(options)
    with pytest.raises(KnightCubeError, match="signal"):
        work(Session(tmp_path, ([], [])), ended=True).obey(options)
    unexplained: Any = Session(tmp_path, ([], []))
    unexplained.entity.ended.append(ending("a", condition=4))
    assert not unexplained.ended("a"), "the satellite's reason may follow"
    unexplained._credit_ns = 3_000_000_000
    with pytest.raises(KnightCubeError, match="a: "):
        unexplained.ended("a")
    silent = Session(tmp_path, ([], []))
    silent.received_ns = -(10**30)
    with pytest.raises(KnightCubeError, match="no packet"):
        work(silent).obey(options)


@pytest.mark.usefixtures("quiet")
@pytest.mark.parametrize(
    ("word", "directive"),
    [("cancel", CancelFile(1, 7)), ("suspend", SuspendFile(1, 7)), ("resume", ResumeFile(1, 7))],
)
def test_commands_on_files_end_when_they_are_completed(
    tmp_path: Path, word: str, directive: Directive
) -> None:
    session = Session(tmp_path, ([report(Stage.STARTED)], []), ([report(Stage.COMPLETED)], []))
    options = cast(Any, SimpleNamespace(what=word, source=1, number=7))
    found = work(session).obey(options)
    assert session.asked == [directive]
    assert found["text"].startswith("completed: ")
    with pytest.raises(KnightCubeError, match="text"):
        work(Session(tmp_path, ([report(Stage.REFUSED)], []))).obey(options)


@pytest.mark.parametrize("name", ["--rate", "--timeout"])
@pytest.mark.parametrize("value", ["0", "-1", "inf"])
def test_rate_and_timeout_of_files_are_positive(name: str, value: str) -> None:
    done = command("files", *LINK, f"{name}={value}", "list")
    assert done.returncode == 2
    assert name in done.stderr


def test_the_result_of_a_file_command_is_printed(
    link: Link, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    facts = {"files": [{"bytes": 12, "name": "a"}], "text": "9 bytes"}
    monkeypatch.setattr(satellite._FileWork, "obey", lambda *_: facts)
    link.sealer = lambda *_: None  # type: ignore[attr-defined]  # the session's only use of the link
    options = ("--folder", str(tmp_path / "store"))
    done = command("files", *LINK, *options, "list")
    assert (done.returncode, done.stdout) == (0, "          12 a\n9 bytes\n")
    assert json.loads(command("files", *LINK, *options, "--json", "list").stdout) == facts
    assert link.closed == 2
    assert Store(tmp_path / "store").outgoing() == []


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(UsageError, match="nothing"):
        satellite._change("nothing=1")
    assert satellite._change(f"{PARAMETER_KEYS[0]}=0.5") == (PARAMETER_KEYS[0], 0.5)
