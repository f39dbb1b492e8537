"""Tests that YAML 1.2 text is read as by an independent library, or refused with the line number."""

from __future__ import annotations

import errno
import json
import math
import os
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML

from flight.app.service import accepted_config
from flight.schema.document import (
    MODULES,
    ConfigError,
    Document,
    _composed,
    _FastLoader,
    _lines_of,
    _Loader,
    config_path,
    imported,
    join,
    read_document,
    read_text,
    to_yaml,
)
from flight.schema.reader import load, merged_text, simulation_section
from sim_hal.settings import Simulation

FOLDER = Path(__file__).resolve().parents[3] / "config"
FILES = sorted(path for path in FOLDER.rglob("*.yaml") if "\nextends:" not in path.read_text("utf-8"))
"""Files without `extends`, because the independent reader does not support this key."""

_PLAIN = st.sampled_from(
    """true True FALSE yes no on off null ~ none x y N -x- a:b 12:30 1:30:00 1.2.3
    1e-3 1E5 -1.5e+3 .5 -.5 1. +7 017 0o17 0x1F 1e e5 0x 0o8 .e1 .""".split()  # noqa: SIM905 - a list is longer
)
_SCALARS = (
    _PLAIN
    | st.integers(-(10**30), 10**30).map(str)
    | st.floats(allow_nan=False, allow_infinity=False).map(repr)
    | st.text(st.characters(exclude_categories=["Cs", "Cc", "Cn"]), max_size=12).map(json.dumps)
)
_KEYS = st.from_regex(r"[a-z_]{1,8}", fullmatch=True).filter(lambda key: key not in {"null", "true", "false"})
_TREES = st.dictionaries(
    _KEYS,
    st.recursive(
        _SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_KEYS, inner, max_size=3)
    ),
    min_size=1,
    max_size=4,
)


def other_reader(text: str) -> Any:
    return YAML(typ="safe", pure=True).load(text)


def written(tree: Any, indent: int, flow: bool) -> str:
    """Return YAML text of nested lists and mappings. The scalars of `value` are already YAML text."""
    if not tree or isinstance(tree, str):
        return f" {tree}" if isinstance(tree, str) else " []" if isinstance(tree, list) else " {}"
    if flow:
        inner = (
            [written(each, 0, flow) for each in tree]
            if isinstance(tree, list)
            else [f"{key}:{written(each, 0, flow)}" for key, each in tree.items()]
        )
        return f" [{','.join(inner)} ]" if isinstance(tree, list) else f" {{{','.join(inner)} }}"
    pad = "\n" + "  " * indent
    if isinstance(tree, list):
        return "".join(f"{pad}-{written(each, indent + 1, flow)}" for each in tree)
    return "".join(f"{pad}{key}:{written(each, indent + 1, flow)}" for key, each in tree.items())


def typed(value: Any) -> Any:
    """Return a value with the type name of each scalar, so that 1, 1.0 and true differ."""
    if isinstance(value, dict):
        return {key: typed(inner) for key, inner in value.items()}
    return [typed(inner) for inner in value] if isinstance(value, list) else (type(value), repr(value))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_both_readers_agree_about_every_shipped_file_and_its_lines(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    document = read_document(text, path.name)
    assert typed(document.values) == typed(other_reader(text))
    compared = 0

    def compare(tree: Any, dotted: str) -> None:
        nonlocal compared
        mapping, listed = isinstance(tree, dict), isinstance(tree, list)
        for key, inner in tree.items() if mapping else enumerate(tree) if listed else ():
            name = join(dotted, str(key)) if mapping else f"{dotted}[{key}]"
            line, _ = tree.lc.key(key) if mapping else tree.lc.item(key)
            assert document.lines[name] == line + 1
            compared += 1
            compare(inner, name)

    compare(YAML(typ="rt", pure=True).load(text), "")
    assert compared == len(document.lines) > 3


def _loaded(compose: Callable[[], tuple[_Loader, Any]]) -> tuple[list[tuple[str, int]], Any] | None:
    """Return the values and lines that a parser reads, or None if the parser refuses the text."""
    try:
        loader, node = compose()
        return list(_lines_of(node, "")), node and loader.construct_document(node)
    except (yaml.YAMLError, ValueError, LookupError):
        return None


def _plainly_composed(text: str) -> tuple[_Loader, Any]:
    loader = _Loader(text)
    return loader, loader.get_single_node()


@given(st.data())
def test_both_parsers_read_the_same_in_a_damaged_file(data: st.DataObject) -> None:
    """The parsers of libyaml and PyYAML read the same values from damaged files, or both refuse them.

    Texts that only libyaml would accept are passed to PyYAML's parser, which refuses them.
    """
    text = FILES[data.draw(st.integers(0, len(FILES) - 1))].read_text("utf-8")
    begin = data.draw(st.integers(0, len(text) - 1))
    text = text[begin : begin + 300].partition("\n")[2]
    for _ in range(data.draw(st.integers(0, 3))):
        at = data.draw(st.integers(0, len(text)))
        text = (
            text[:at]
            + data.draw(st.sampled_from([*"abc:-[]{},#&*|>'\"%@`\n 01.~\t!?\ufeff\r\x85"]))
            + text[at + 1 :]
        )
    assert _loaded(lambda: _composed(text)) == _loaded(lambda: _plainly_composed(text))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_shipped_file_is_read_by_the_fast_parser(path: Path) -> None:
    text = path.read_text("utf-8")
    if yaml.__with_libyaml__:
        assert isinstance(_composed(text)[0], _FastLoader)
    assert _loaded(lambda: _composed(text)) == _loaded(lambda: _plainly_composed(text))


@given(_TREES, st.booleans())
def test_both_readers_agree_about_documents_of_plain_and_quoted_scalars(tree: Any, flow: bool) -> None:
    text = written(tree, 0, flow).strip() + "\n"
    assert typed(read_document(text, "made").values) == typed(other_reader(text))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        (".5e3", 500.0),
        ("1.", 1.0),
        ("017", 17),
        ("0o17", 15),
        ("0x1F", 31),
        ("-7", -7),
        ("TRUE", True),
        ("~", None),
        ("", None),
        ("yes", "yes"),
        ("off", "off"),
        ("1:30", "1:30"),
        ("1_000", "1_000"),
        ("2026-11-26", "2026-11-26"),
        ("<<", "<<"),
        ("'1'", "1"),
        ("!!str 1", "1"),
        ("!!float 1", 1.0),
        ("!!int 0x10", 16),
    ],
)
def test_scalars_follow_the_core_schema_of_yaml_1_2(text: str, value: object) -> None:
    assert typed(read_document(f"a: {text}\n", "x").values["a"]) == typed(value)


@given(st.recursive(st.none() | st.booleans() | st.integers() | st.text(), lambda v: st.lists(v, max_size=3)))
def test_values_that_are_written_are_read_back_by_both_readers(value: Any) -> None:
    text = to_yaml({"a": value})
    assert typed(read_document(text, "written").values["a"]) == typed(value)
    assert typed(other_reader(text)["a"]) == typed(value)


@pytest.mark.parametrize(
    "tag", ["!!set {x}", "!!binary eA==", "!!timestamp 2026-11-26", "!own 1", "!!omap []"]
)
def test_tags_beyond_the_core_schema_are_refused_with_their_line(tag: str) -> None:
    with pytest.raises(ConfigError, match=r"^x:2: is not YAML: could not determine a constructor"):
        read_document(f"b: 1\na: {tag}\n", "x")


def test_a_file_is_read_up_to_its_largest_length(tmp_path: Path) -> None:
    path = tmp_path / "long.yaml"
    path.write_text("#" * (1 << 20), encoding="utf-8")
    assert len(read_text(path)) == 1 << 20
    path.write_text("#" * ((1 << 20) + 1), encoding="utf-8")
    with pytest.raises(ConfigError, match="is longer than 1048576 characters"):
        read_text(path)


def test_a_bare_name_is_a_configuration_of_the_package_and_everything_else_a_path() -> None:
    assert config_path("step_demo").resolve() == FOLDER / "step_demo.yaml"
    for text in ("step_demo.yaml", "./step_demo", "nothing"):
        assert config_path(text) == Path(text)


def write(folder: Path, name: str, text: str) -> Path:
    """Write a file of indented text into a folder."""
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(textwrap.dedent(text), encoding="utf-8")
    return path


def read(path: Path) -> Document:
    return read_document(read_text(path), str(path))


def test_a_file_takes_over_mappings_key_by_key_and_replaces_lists_and_scalars(tmp_path: Path) -> None:
    write(
        tmp_path,
        "base.yaml",
        """\
        name: base
        coils: {limit: 1, pair: [1, 2, 3], deep: {a: 1, b: 2}}
        targets: [{at: 0}, {at: 1}]
        camera: {rows: 5}
        """,
    )
    write(tmp_path, "sub/middle.yaml", "extends: ../base.yaml\nname: middle\ncoils: {limit: 7}\n")
    top = write(
        tmp_path,
        "top.yaml",
        """\
        # a comment
        extends: sub/middle.yaml
        coils:
          pair: [4]
          deep: {b: 3}
        targets: [{at: 9}]
        camera: none
        """,
    )
    document = read(top)
    assert document.values == {
        "name": "middle",
        "coils": {"limit": 7, "pair": [4], "deep": {"a": 1, "b": 3}},
        "targets": [{"at": 9}],
        "camera": "none",
    }
    assert document.chain == (
        str(top),
        str(tmp_path / "sub/middle.yaml"),
        str(tmp_path / "sub/../base.yaml"),
    )
    middle, base = document.chain[1:]
    for dotted, place in (
        ("name", f"{middle}:2"),
        ("coils", f"{top}:3"),
        ("coils.limit", f"{middle}:3"),
        ("coils.pair", f"{top}:4"),
        ("coils.deep.a", f"{base}:2"),
        ("coils.deep.b", f"{top}:5"),
        ("coils.absent", f"{top}:3"),
        ("targets[0].at", f"{top}:6"),
        ("targets[1].at", f"{top}:6"),
        ("camera.rows", f"{top}:7"),
    ):
        assert document.error(dotted, "").where == place, dotted
    merged = merged_text(read_text(top), str(top))
    assert merged.startswith("# merged from 'top.yaml', 'middle.yaml', 'base.yaml'\n")
    assert read_document(merged, "elsewhere").values == document.values
    assert merged_text("a: 1 # as it is\n", "one") == "a: 1 # as it is\n"


@pytest.mark.parametrize("named", ["orbit_3u", "orbit_3u.yaml"])
def test_a_packaged_configuration_is_extended_by_its_name(tmp_path: Path, named: str) -> None:
    top = write(tmp_path, "top.yaml", f"extends: {named}\nname: mine\n")
    assert read(top).values == read(FOLDER / "orbit_3u.yaml").values | {"name": "mine"}
    # A file in the folder of the extending file has precedence over a packaged file of the same name. A name
    # without `.yaml` always means the packaged file.
    write(tmp_path, "orbit_3u.yaml", "own: 1\n")
    assert ("own" in read(top).values) == named.endswith(".yaml")


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"a.yaml": "extends: a.yaml\n"}, ["a.yaml:1", "in a circle: a.yaml, a.yaml"]),
        (
            {"a.yaml": "extends: b.yaml\n", "b.yaml": "x: 1\nextends: c.yaml\n", "c.yaml": "extends: b.yaml"},
            ["c.yaml:1", "in a circle: b.yaml, c.yaml, b.yaml"],
        ),
        ({"a.yaml": "x: 1\nextends: none.yaml\n"}, ["a.yaml:2", "'none.yaml'", "no such file", "orbit_3u"]),
        ({"a.yaml": "extends: [b]\n"}, ["a.yaml:1", "is ['b']: give the path of a file"]),
        ({"a.yaml": 'extends: "b\\0"\n'}, ["a.yaml:1", "give the path of a file"]),
        ({"a.yaml": f"extends: {'b' * 5000}\n"}, ["a.yaml:1", "bb: give the path of a file"]),
        ({"a.yaml": "extends: .\n"}, ["a.yaml:1", "cannot be read"]),
        ({"a.yaml": "extends: b.yaml\n", "b.yaml": "x: [\n"}, ["b.yaml:2", "is not YAML"]),
        ({"a.yaml": "extends: b.yaml\n", "b.yaml": "x:\n  y: .inf\n"}, ["b.yaml:2", "`x.y` is inf"]),
    ],
)
def test_a_wrong_extension_is_refused_with_its_place(
    tmp_path: Path, files: dict[str, str], words: list[str]
) -> None:
    for name, text in files.items():
        write(tmp_path, name, text)
    with pytest.raises(ConfigError) as caught:
        read(tmp_path / "a.yaml")
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_errors_of_sections_name_the_file_of_the_value(tmp_path: Path) -> None:
    text = read_text(FOLDER / "orbit.yaml")
    wrong = text.replace("release: {speed: 0.1745}", "release: {speed: -1.0}")
    line = 1 + next(i for i, one in enumerate(wrong.splitlines()) if "speed: -1.0" in one)
    write(tmp_path, "base.yaml", wrong)
    top = write(
        tmp_path, "top.yaml", "extends: base.yaml\nsimulation: {seed: 2}\ncoils: {supply_voltage: -1}\n"
    )
    with pytest.raises(ConfigError, match=r"top\.yaml:3: `coils\.supply_voltage` is -1"):
        load(top)
    with pytest.raises(
        ConfigError, match=rf"base\.yaml:{line}: `simulation\.free_body\.release\.speed` is -1"
    ):
        simulation_section(read_text(top), str(top), Simulation)


@pytest.mark.parametrize(
    ("content", "mode", "permitted"),
    [
        ("math:tau\n", 0o644, True),
        ("math:pi\nmath:tau", 0o600, True),
        ("math:e\n", 0o644, False),
        ("math:tau\n", 0o664, False),
        ("math:tau\n", 0o646, False),
        (None, 0o644, False),
    ],
)
def test_a_board_imports_only_what_a_file_of_root_permits(
    tmp_path: Path, content: str | None, mode: int, permitted: bool
) -> None:
    path = tmp_path / "modules"
    if content is not None:
        path.write_text(content, encoding="utf-8")
        path.chmod(mode)
    board = {MODULES: str(path)}
    assert imported("body", "known", {"known": "math:e"}, board) == math.e
    if permitted and os.getuid() == 0:
        assert imported("body", "math:tau", {}, board) == math.tau
    else:
        with pytest.raises(ConfigError, match=r"not permitted: add it as a line to .* as root"):
            imported("body", "math:tau", {}, board)
    assert imported("body", "math:tau", {}, {}) == math.tau, "not a board"


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file away")
def test_a_list_that_another_user_owns_or_a_fifo_permits_nothing(tmp_path: Path) -> None:
    path = tmp_path / "modules"
    path.write_text("math:tau\n", encoding="utf-8")
    os.chown(path, 1000, 0)
    fifo, link = tmp_path / "fifo", tmp_path / "link"
    os.mkfifo(fifo)
    link.symlink_to("/dev/zero")
    for file in (path, fifo, link):
        with pytest.raises(ConfigError, match="add it as a line"):
            imported("simulation.world", "math:tau", {}, {MODULES: str(file)})


def test_on_a_board_a_disk_error_at_an_import_does_not_refuse_the_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A service does not start again after a ConfigError, but retries after an OSError."""
    known, board = {"plain": "tests.support.places:ROOT"}, {MODULES: str(tmp_path / "modules")}

    def fail(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patch:
        patch.setattr("flight.schema.document.importlib.import_module", fail)
        with pytest.raises(OSError, match="Input/output error"):
            imported("body", "plain", known, board)
        with pytest.raises(ConfigError, match=r"cannot be imported: .*Input/output error"):
            imported("body", "plain", known, {})
    monkeypatch.setattr("flight.schema.document._without_waiting", fail)
    with pytest.raises(OSError, match="Input/output error"):
        imported("body", "math:tau", {}, board)


@pytest.mark.parametrize("read", [read_text, lambda path: accepted_config(path, {}).text])
def test_a_file_in_another_encoding_names_the_byte_and_the_cure(
    tmp_path: Path, read: Callable[[Path], str]
) -> None:
    path = tmp_path / "latin.yaml"
    path.write_bytes("name: café\n".encode("latin-1"))
    with pytest.raises(ConfigError, match="is not UTF-8, byte 0xe9: save the file as text in UTF-8"):
        read(path)
