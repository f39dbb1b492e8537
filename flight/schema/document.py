"""Converts configuration text to typed sections; errors state file, line, value and remedy.

Plain scalars follow the core schema of YAML 1.2: `1e-5` and `0o17` are numbers, `yes` and `12:30` are texts.
Aliases, duplicate keys, application tags, infinite numbers and NaN are rejected. A file with the key
`extends` takes over the values of another file and replaces some of them. The last part defines the types of
values with their bounds, and the values of a pointing goal.
"""

from __future__ import annotations

import copy
import difflib
import errno
import importlib
import math
import os
import re
import stat
import sys
import traceback
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import msgspec
import numpy as np
import yaml
from msgspec import Meta, inspect

from hal.interfaces.errors import DeviceError, NotResponding
from knightcube.astro.arrays import FloatArray
from knightcube.errors import InputError, KnightCubeError, reason_of
from knightcube.gnc.guidance.plant import Q2_LIMIT
from knightcube.gnc.guidance.pointing_target import ROLLS, Goal, PointingTarget

FOLDER = Path(__file__).parent / "configurations"
"""Folder of the packaged configurations, which is a link to the folder `config` of the repository."""
EXTENDS = "extends"
"""Key whose value names the file that a configuration extends."""
_LONGEST = 1 << 20
"""Maximum length of a configuration file, in characters."""
_LONGEST_PATH = 1024
"""Maximum length of the path of an extended file, in characters."""


class ConfigError(InputError):
    """A configuration that cannot be flown; `where` is the file and, if known, the line of the value."""


class UnreadConfigError(ConfigError):
    """A configuration whose values were not checked: it cannot be read, or was never accepted."""


@dataclass(frozen=True, slots=True)
class Document:
    """The values of a configuration file, including those of the files that it extends.

    Attributes:
        values: values without the key `extends`.
        name: name of the file in messages.
        lines: line of each dotted name (`steps[1].at`), in the file that gives its value.
        files: name of the extended file for each dotted name whose value that file gives.
        chain: name of this file, of the file that it extends, and so on.
    """

    values: dict[str, Any]
    name: str
    lines: dict[str, int]
    files: dict[str, str] = field(default_factory=dict)
    chain: tuple[str, ...] = ()

    def error(self, dotted: str, problem: str) -> ConfigError:
        """Return an error about a value, with the line of the value or of the nearest enclosing section."""
        known = dotted
        while known and known not in self.lines:
            known = re.sub(r"(\.[^.\[]+|\[[^\]]*\]|^[^.\[]+)$", "", known)
        where = f"{self.files.get(known, self.name)}:{self.lines[known]}" if known else self.name
        return ConfigError(where, f"`{dotted or 'configuration'}` {problem}")

    def depth(self, dotted: str) -> int:
        """Return the place in the chain of the file that gives a value: 0 for this file."""
        return self.chain.index(self.files.get(dotted, self.name)) if self.chain else 0


MODULES = "KNIGHTCUBE_MODULES"
"""Environment variable of a flight computer: path of a file that lists objects (`module:object`) that a
configuration may import, in addition to the known objects."""


MISTAKES = (
    AssertionError,
    ImportError,
    AttributeError,
    SyntaxError,
    NameError,
    TypeError,
    ValueError,
    LookupError,
    ArithmeticError,
    OSError,
    RuntimeError,
)
"""Exceptions that programming errors usually raise, during the import of a module or in its functions."""


def imported(key: str, named: str, known: Mapping[str, str], environment: Mapping[str, str]) -> Any:
    """Return the object `module:object`; `known` maps short names to such texts. Raises ConfigError.

    A flight computer imports only known objects and the objects in the file that `KNIGHTCUBE_MODULES` names.
    Raises OSError if a flight computer cannot read a file, because a later attempt may succeed.
    """
    place = known.get(named, named)
    module, colon, name = place.partition(":")
    if not (module and colon and name):
        raise ConfigError(key, f"is {named!r}: name one of {', '.join(known)}, or `module:object`")
    file = environment.get(MODULES)
    if file is not None and place not in known.values() and place not in _permitted_objects(Path(file)):
        raise ConfigError(key, f"is {named!r}, which is not permitted: add it as a line to {file} as root")
    try:
        return getattr(importlib.import_module(module), name)
    except MISTAKES as error:
        if isinstance(error, OSError) and file is not None:
            raise
        problem = _import_problem(module, name, error, on_board=file is not None)
        raise ConfigError(key, f"is {named!r}, which cannot be imported: {problem}") from error


def _import_problem(module: str, name: str, error: Exception, on_board: bool) -> str:
    """Return why an object cannot be imported, with the file and line of an error, and the remedy."""
    if isinstance(error, ModuleNotFoundError) and error.name and f"{module}.".startswith(f"{error.name}."):
        here = "" if on_board else f"set PYTHONPATH to the folder of {error.name.partition('.')[0]}.py, or "
        return f"{error}: {here}install the package that provides it"
    loaded = sys.modules.get(module)
    if isinstance(error, AttributeError) and error.obj is loaded is not None:
        close = difflib.get_close_matches(name.lower(), {one.lower(): one for one in dir(loaded)}, n=1)
        similar = [one for one in dir(loaded) if close and one.lower() == close[0]]
        return f"{error}" + (f", did you mean `{module}:{similar[0]}`?" if similar else "")
    if isinstance(error, SyntaxError):
        return f"{error.filename}:{error.lineno}: {error.msg}"
    return _mistake(error, None, ": correct this line, or install the package that it needs")


def call_named(
    key: str, named: str, function: Callable[..., Any], *arguments: Any, device: bool = False
) -> Any:
    """Return the result of `function`, which belongs to the object `named` that the key `key` gives.

    Raises ConfigError, with the file and line, if the function fails because of a mistake in its code. If the
    function uses a `device`, NotResponding is raised instead, because the device may also have caused the
    failure, and a service does not restart after a ConfigError.
    """
    try:
        return function(*arguments)
    except (KnightCubeError, DeviceError):
        raise
    except MISTAKES as error:
        file = getattr(sys.modules.get(named.partition(":")[0]), "__file__", None)
        name = getattr(function, "__name__", type(function).__name__)
        problem = f"is {named!r}, whose function `{name}` failed: "
        if device:
            cure = ": check the device, or correct this line"
            raise NotResponding(f"`{key}`", problem + _mistake(error, file, cure)) from error
        raise ConfigError(key, problem + _mistake(error, file, ": correct this line")) from error


def _mistake(error: Exception, file: str | None, cure: str) -> str:
    """Return the text of an error with its location, if possible in `file`, and the remedy `cure`."""
    frames = [one for one in traceback.extract_tb(error.__traceback__) if not one.filename.startswith("<")]
    own = [one for one in frames if one.filename == file] or frames
    where = f"{own[-1].filename}:{own[-1].lineno}: " if own and own[-1].filename != __file__ else ""
    return f"{where}{type(error).__name__}: {error}{cure if where else ''}"


_TRANSIENT = frozenset({errno.EIO, errno.ENOMEM, errno.EMFILE, errno.ENFILE})
"""Error numbers of a failing disk and of exhausted memory or descriptors: a later attempt may succeed."""


def _permitted_objects(path: Path) -> list[str]:
    """Return the lines of a file, or nothing if anybody but root could have written it.

    Raises OSError for a transient error.
    """
    try:
        with open(path, encoding="utf-8", opener=_without_waiting) as file:
            found = os.fstat(file.fileno())
            if stat.S_ISREG(found.st_mode) and found.st_uid == 0 and not found.st_mode & 0o022:
                return file.read(_LONGEST).split()
    except UnicodeDecodeError:
        pass
    except OSError as error:
        if error.errno in _TRANSIENT:
            raise
    return []


def _without_waiting(path: str, flags: int) -> int:
    """Open a file; a FIFO at this path does not block."""
    return os.open(path, flags | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)


class _Loader(yaml.SafeLoader):
    """Loads the core schema of YAML 1.2 and rejects aliases.

    Aliases are rejected, because a few lines of them can expand to more values than the memory holds.
    """

    yaml_constructors: ClassVar[dict[Any, Any]] = {
        tag: yaml.SafeLoader.yaml_constructors[tag]
        for tag in (None, *(f"tag:yaml.org,2002:{kind}" for kind in ("map", "seq", "str", "null", "bool")))
    }

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return the next node. Raises ComposerError if the node is an alias."""
        if self.check_event(yaml.AliasEvent):
            mark = self.get_event().start_mark  # type: ignore[no-untyped-call]  # of PyYAML's stubs
            raise yaml.composer.ComposerError(None, None, "an alias (*): write the value out", mark)
        return super().compose_node(parent, index)

    def construct_integer(self, node: yaml.ScalarNode) -> int:
        """Return the integer of a decimal, octal (0o) or hexadecimal (0x) number. Raises ValueError."""
        text = self.construct_scalar(node)
        return int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))

    def construct_number(self, node: yaml.ScalarNode) -> float:
        """Return a floating-point number; infinity and NaN are `.inf` and `.nan`. Raises ValueError."""
        text = self.construct_scalar(node)
        return float(re.sub(r"\.(?=inf|nan)", "", text.lower()))


_TOLERATED = re.compile("[\t!?\ufeff]|[|>][0-9+-]*#")
"""Characters that libyaml accepts in more places of a YAML text, or interprets differently, than PyYAML's own
parser."""


class _FastLoader(_Loader):
    """Loads a text with the parser of libyaml, which takes a tenth of the time of PyYAML's own parser.

    Raises ImportError if PyYAML was built without libyaml.
    """

    def __init__(self, text: str) -> None:
        super().__init__("")
        parser = importlib.import_module("yaml.cyaml").CParser(text)
        vars(self).update(
            (name, getattr(parser, name)) for name in ("check_event", "peek_event", "get_event")
        )


class _Dumper(yaml.SafeDumper):
    """Quotes the texts that the core schema of YAML 1.2 would otherwise read as numbers, booleans or null."""


# PyYAML would resolve plain scalars by YAML 1.1, so its patterns are replaced by those of YAML 1.2.
_Loader.yaml_implicit_resolvers = _Dumper.yaml_implicit_resolvers = {}
for _kind, _pattern in (
    ("null", r"(?:null|Null|NULL|~|)$"),
    ("bool", r"(?:true|True|TRUE|false|False|FALSE)$"),
    ("int", r"(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$"),
    ("float", r"(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?)$"),
    ("float", r"(?:[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_kind}", re.compile(_pattern), None)
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_integer)
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_number)


def config_path(text: str) -> Path:
    """Return the file that a command line argument names: a packaged configuration or a path.

    For example, `step_demo` is a name, whereas `step_demo.yaml` and `./step_demo` are paths.
    """
    packaged = FOLDER / f"{text}.yaml"
    return packaged if re.fullmatch(r"\w+", text) and packaged.is_file() else Path(text)


def read_text(path: Path, packaged: bool = True) -> str:
    """Return the text of a configuration file of at most 1 MiB. Raises ConfigError.

    If `packaged` is true, the message about a missing file lists the packaged configurations.
    """
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(_LONGEST + 1)  # a device file may be endless
    except FileNotFoundError as error:
        missing = no_such_file(path) if packaged else "no such file; check the path"
        raise UnreadConfigError(str(path), f"cannot be read: {missing}") from error
    except OSError as error:
        raise UnreadConfigError(str(path), f"cannot be read: {reason_of(error)}") from error
    except UnicodeDecodeError as error:
        raise not_utf_8(path, error) from error
    return checked_length(text, path)


def not_utf_8(path: Path, error: UnicodeDecodeError) -> ConfigError:
    """Return the error for a file that is not UTF-8; the error states the first invalid byte."""
    byte = error.object[error.start]
    return ConfigError(str(path), f"is not UTF-8, byte 0x{byte:02x}: save the file as text in UTF-8")


def names() -> list[str]:
    """Return the names of the packaged configurations, without `.yaml`."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def no_such_file(path: Path) -> str:
    """Return the message about a missing file; it names a similar packaged configuration, or else all."""
    known = names()
    similar = difflib.get_close_matches(path.name.removesuffix(".yaml"), known, n=1, cutoff=0.75)
    if similar:
        return f"no such file; did you mean the packaged configuration `{similar[0]}`?"
    return f"no such file; the packaged configurations are {', '.join(known)}"


def checked_length(text: str, path: Path) -> str:
    """Return the text of a file unchanged. Raises ConfigError if the text is longer than 1 MiB."""
    if len(text) > _LONGEST:
        raise ConfigError(str(path), f"is longer than {_LONGEST} characters")
    return text


def read_document(text: str, name: str) -> Document:
    """Return the values of a YAML text, including those of the files that it extends.

    The value of the key `extends` is a path relative to the file `name`, or the name of a packaged
    configuration. Mappings are merged key by key; lists and scalars replace the values of the extended file.
    Error messages name the file that contains the value.

    Raises ConfigError, for example if files extend each other in a circle, and UnreadConfigError if an
    extended file cannot be read.
    """
    return _extended(_read_single(text, name), ())


def _extended(document: Document, above: tuple[str, ...]) -> Document:
    """Return a document merged with the file that it extends.

    The names `above` belong to the files that extend this document, directly or through other files.
    """
    if EXTENDS not in document.values:
        return document
    named = document.values.pop(EXTENDS)
    place = document.error(EXTENDS, "").where
    if not isinstance(named, str) or "\0" in named or len(named) > _LONGEST_PATH:
        problem = (
            f"is {repr(named)[:_LONGEST_VALUE]}: give the path of a file, or the name of a configuration"
        )
        raise document.error(EXTENDS, problem)
    path = Path(document.name).parent / named
    if named in names() or (named.removesuffix(".yaml") in names() and not os.path.lexists(path)):
        path = FOLDER / f"{named.removesuffix('.yaml')}.yaml"
    above, real = (*above, os.path.realpath(document.name)), os.path.realpath(path)
    if real in above:
        circle = ", ".join(Path(file).name for file in (*above[above.index(real) :], real))
        raise document.error(EXTENDS, f"is {named!r}: these files extend each other in a circle: {circle}")
    try:
        text = read_text(path)
    except ConfigError as error:
        raise type(error)(place, f"`{EXTENDS}` is {named!r}: {error}") from error
    base = _extended(_read_single(text, str(path)), above)
    del document.lines[EXTENDS]
    lines, sources = dict(base.lines), {dotted: base.files.get(dotted, base.name) for dotted in base.lines}
    values = _merged(base.values, document.values, "", lines)
    for dotted, line in document.lines.items():
        lines[dotted] = line
        sources.pop(dotted, None)
    files_of = {dotted: source for dotted, source in sources.items() if dotted in lines}
    return Document(values, document.name, lines, files_of, (document.name, *base.chain))


def _merged(base: Any, own: Any, dotted: str, lines: dict[str, int]) -> Any:
    """Return the values `base` with the replacements `own`; delete the line numbers of replaced values."""
    if isinstance(base, dict) and isinstance(own, dict):
        merged = dict(base)
        for key, value in own.items():
            below = join(dotted, str(key))
            merged[key] = _merged(base[key], value, below, lines) if key in base else value
        return merged
    for name in [name for name in lines if name.startswith((f"{dotted}.", f"{dotted}["))]:
        del lines[name]
    return own


def _read_single(text: str, name: str) -> Document:
    """Return the values of a YAML text, but not of a file that it extends. Raises ConfigError."""
    read = _read_once(text, name)
    return replace(read, values=copy.deepcopy(read.values), lines=dict(read.lines))


@lru_cache(maxsize=8)  # a command reads a configuration up to seven times
def _read_once(text: str, name: str) -> Document:
    lines: dict[str, int] = {}
    try:
        loader, node = _composed(text)
        for child, line in _lines_of(node, ""):
            if child in lines:
                raise ConfigError(f"{name}:{line}", f"`{child}` is given twice, first in line {lines[child]}")
            lines[child] = line
        values = None if node is None else loader.construct_document(node)
    except RecursionError as error:
        raise ConfigError(name, "is nested too deeply") from error
    # Apart from YAMLError, the exceptions come from values that do not fit their explicit tag (`!!int x`).
    except (yaml.YAMLError, ValueError, LookupError, ArithmeticError, AttributeError, TypeError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{name}:{mark.line + 1}" if mark else name
        problem = getattr(error, "problem", None) or str(error)
        problem += next((cure for text, cure in _YAML_CURES.items() if text in problem), "")
        raise ConfigError(where, f"is not YAML: {problem.splitlines()[0]}") from error
    if not isinstance(values, dict):
        problem = "is empty" if values is None else "is not a mapping"
        raise ConfigError(name, f"{problem}: give lines of the form `key: value`")
    document = Document(values, name, lines, chain=(name,))
    _check_plain(values, "", document)
    return document


def _composed(text: str) -> tuple[_Loader, yaml.Node | None]:
    """Return a loader and the root node of a text. Raises YAMLError with the text of PyYAML's own parser."""
    if not _TOLERATED.search(text):
        with suppress(ImportError, yaml.YAMLError):
            fast = _FastLoader(text)
            return fast, fast.get_single_node()
    loader = _Loader(text)
    return loader, loader.get_single_node()


def to_yaml(values: dict[str, Any]) -> str:
    """Return plain values as YAML text, without changing their order."""
    # The text is ASCII only, because PyYAML folds some Unicode line breaks that it does not escape.
    return yaml.dump(values, Dumper=_Dumper, default_flow_style=False, sort_keys=False)


def join(prefix: str, key: str) -> str:
    """Return the dotted name of a key, or of an index in brackets, below a prefix."""
    return f"{prefix}.{key}" if prefix and key and not key.startswith("[") else prefix + key


def _lines_of(node: yaml.Node | None, dotted: str) -> Iterator[tuple[str, int]]:
    """Yield the dotted name and the line of every value below a node."""
    if isinstance(node, yaml.MappingNode):
        children = [(join(dotted, str(key.value)), key, value) for key, value in node.value]
    elif isinstance(node, yaml.SequenceNode):
        children = [(f"{dotted}[{index}]", value, value) for index, value in enumerate(node.value)]
    else:
        return
    for name, first, value in children:
        yield name, first.start_mark.line + 1
        yield from _lines_of(value, name)


def _check_plain(value: Any, dotted: str, document: Document) -> None:
    if isinstance(value, dict):
        for key, child in value.items():
            if not isinstance(key, str):
                cure = "keys are texts; write decimals with a point, such as 4.5, and lists in brackets"
                raise document.error(join(dotted, str(key)), f"is not a key: {cure}")
            _check_plain(child, join(dotted, str(key)), document)
    elif isinstance(value, list):
        for index, child in enumerate(value):
            _check_plain(child, f"{dotted}[{index}]", document)
    elif isinstance(value, float) and not math.isfinite(value):
        raise document.error(dotted, f"is {value!r}: must be a finite number")


T = TypeVar("T")

_NOUNS = {
    "object": "a section",
    "array": "a list",
    "str": "a text",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "null": "nothing",
}
"""Plain nouns that replace the type names in the messages of msgspec."""
_LONGEST_VALUE = 200
"""Maximum number of characters of a value in a message."""


def convert(document: Document, shape: type[T], section: str = "") -> T:
    """Return a document, or one section of it, as an object of the type `shape`. Raises ConfigError."""
    tree: Any = document.values[section] if section else document.values
    try:
        return msgspec.convert(tree, shape)
    except msgspec.ValidationError as error:
        message, _, place = str(error).partition(" - at ")
        path = place.partition("`$")[2].rstrip("`")
        dotted = join(section, path.lstrip("."))
        if place.startswith("`key` in "):
            raise document.error(*_key_problem(message, shape, path, dotted)) from error
        unknown = re.match(r"Object contains unknown field `(.+)`", message)
        if unknown:
            key = unknown.group(1)
            problem = "is an unknown key" + _nearest(key, shape, tree, path)
            raise document.error(join(dotted, key), problem) from error
        missing = re.match(r"Object missing required field `(.+)`", message)
        if missing:
            hint = _description(_kinds_at(shape, f"{path}.{missing.group(1)}"))
            article = "" if hint.startswith(("a ", "an ", "the ")) else "the "
            problem = "is missing" + (f": give {article}{hint}" if hint else "")
            raise document.error(join(dotted, missing.group(1)), problem) from error
        below = " >" in message
        message = _permitted(message, shape, path)
        try:
            value = _value_at(tree, path)
        except (KeyError, IndexError, TypeError, ValueError):
            pass  # msgspec writes [...] for an unknown index
        else:
            if not isinstance(value, dict):
                hexadecimal = isinstance(value, int) and dotted.endswith("address")
                text = f"{value:#04x} ({value})" if hexadecimal else repr(value)
                cut = text if len(text) <= _LONGEST_VALUE else text[:_LONGEST_VALUE] + "..."
                message = f"is {cut}: {message}{_unit_hint(dotted, value, message, below)}"
        raise document.error(dotted, message) from error


def _steps_of(path: str) -> list[tuple[str, str]]:
    """Split a msgspec path such as `.coils.channels[1]` into keys (key, "") and indices ("", index)."""
    return re.findall(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]", path)


def _value_at(tree: Any, path: str) -> Any:
    """Return the value at a msgspec path. Raises an exception for a path that is not in the tree."""
    for key, index in _steps_of(path):
        tree = tree[key] if key else tree[int(index)]
    return tree


def _key_problem(message: str, shape: Any, path: str, dotted: str) -> tuple[str, str]:
    """Return the dotted name and the problem of a key that the mapping at `path` does not accept."""
    kinds = [kind for kind in _kinds_at(shape, path) if isinstance(kind, inspect.DictType)]
    choices = [
        str(value)
        for kind in kinds
        for key in _alternatives(kind.key_type)
        if isinstance(key, inspect.LiteralType)
        for value in key.values
    ]
    given = re.fullmatch(r"Invalid enum value '?(.+?)'?", message)
    if given and choices:
        return join(dotted, given.group(1)), f"is an unknown key: expected one of {', '.join(choices)}"
    return dotted, f"has a wrong key: {_plain(message)}"


_YAML_CURES = {
    "'\\t'": ": indent with spaces",
    "another document": ": remove the line `---`",
    "expected <block end>": ": check brackets, commas and the indentation",
}
"""Remedies for texts that are not YAML, by a part of the parser's message."""


def _unit_hint(dotted: str, value: Any, message: str, below: bool) -> str:
    """Return a hint if a value was written with a unit, or in rad although the key expects deg.

    The flag `below` states whether the value is below its range.
    """
    if isinstance(value, str) and "a number" in message and re.match(r"\s*[-+]?[0-9]", value):
        quoted = re.fullmatch(r"\s*[-+]?[0-9.]+([eE][-+]?[0-9]+)?\s*", value)
        return f": write the number without {'quotes' if quoted else 'a unit'}"
    if below and dotted.endswith("_deg") and isinstance(value, int | float) and 0.0 < value < 6.3:
        return f": the unit is deg, and {value:g} rad are {math.degrees(value):.4g} deg"
    return ""


def _nearest(key: str, shape: Any, tree: Any, path: str) -> str:
    """Suggest a known key for an unknown `key` of the struct at `path`; prefer keys that begin with `key`."""
    for step in re.findall(r"\.([^.\[]+)", path):
        fields = {f.encode_name: f.type for f in msgspec.structs.fields(shape)}
        tree = tree.get(step) if isinstance(tree, dict) else None
        shape = _struct_of(fields.get(step), tree)
        if shape is None:
            return ""
    names = [f.encode_name for f in msgspec.structs.fields(shape)]
    close = [name for name in names if name.startswith(key)]
    close = close or difflib.get_close_matches(key, names, n=1, cutoff=0.6)
    return f", did you mean `{close[0]}`?" if close else f"; known keys: {', '.join(names)}"


def _struct_of(annotation: Any, tree: Any) -> Any:
    """Return the struct class in an annotation such as `Camera | None`, selected by the tag in `tree`."""
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        config = annotation.__struct_config__
        tag = tree.get(config.tag_field) if isinstance(tree, dict) and config.tag_field else config.tag
        return annotation if tag == config.tag else None
    for inner in getattr(annotation, "__args__", ()):
        if (found := _struct_of(inner, tree)) is not None:
            return found
    return None


def _permitted(message: str, shape: Any, path: str) -> str:
    """Return msgspec's message about the value at `path`, with the permitted values of the type `shape`."""
    kinds = _kinds_at(shape, path)
    choices = [value for kind in kinds if isinstance(kind, inspect.LiteralType) for value in kind.values]
    if choices:
        return "expected one of " + ", ".join(map(str, choices))
    hint = _description(kinds)
    if "matching regex" in message and hint:
        return f"expected {hint}"
    limits = _limits(kinds) if re.match(r"Expected `(float|int)` [<>]", message) else ""
    said = f"must be {limits}" if limits else _plain(message)
    return said + (f" ({hint})" if hint and not (limits and limits in hint) else "")


def _limits(kinds: list[inspect.Type]) -> str:
    """Return the range of a number, such as `64 to 8192`, or an empty text if the types differ in range."""
    found = {
        (kind.gt, kind.ge, kind.lt, kind.le)
        for kind in kinds
        if isinstance(kind, inspect.FloatType | inspect.IntType)
    }
    if len(found) != 1:
        return ""
    bounds = [f"{bound:.7g}" if isinstance(bound, float) else bound for bound in found.pop()]
    above, least, below, most = bounds
    if least is not None and most is not None:
        return f"{least} to {most}"
    words = {"above": above, "at least": least, "below": below, "at most": most}
    return " and ".join(f"{word} {bound}" for word, bound in words.items() if bound is not None)


def _plain(message: str) -> str:
    """Return a message of msgspec with plain nouns instead of type names, such as `float | null`."""

    def nouns(found: re.Match[str]) -> str:
        return " or ".join(_NOUNS[name] for name in found.group(1).split(" | "))

    names = "|".join(_NOUNS)
    return re.sub(rf"`((?:{names})(?: \| (?:{names}))*)`", nouns, message[0].lower() + message[1:])


def _kinds_at(shape: Any, path: str) -> list[inspect.Type]:
    """Return the types that the value at `path` may have, with the metadata of each."""
    kinds: list[inspect.Type] = _alternatives(inspect.type_info(shape))
    for key, index in _steps_of(path):
        kinds = [
            inner for kind in kinds for each in _within(kind, key, index) for inner in _alternatives(each)
        ]
    return kinds


def _description(kinds: list[inspect.Type]) -> str:
    """Return the description of a value from its type, or an empty text if there is none."""
    schemas = [kind.extra_json_schema or {} for kind in kinds if isinstance(kind, inspect.Metadata)]
    return " or ".join(str(schema["description"]) for schema in schemas if "description" in schema)


def _alternatives(kind: inspect.Type) -> list[inspect.Type]:
    """Return the members of a union type, with the metadata of each."""
    if isinstance(kind, inspect.Metadata):
        return [kind, *_alternatives(kind.type)]
    if isinstance(kind, inspect.UnionType):
        return [inner for each in kind.types for inner in _alternatives(each)]
    return [kind]


def _within(kind: inspect.Type, key: str, index: str) -> list[inspect.Type]:
    """Return the types of `key` or `index` within the type `kind`; the tag of a struct has a literal type."""
    if isinstance(kind, inspect.StructType) and key:
        if key == kind.tag_field:
            return [inspect.LiteralType((kind.tag,))]
        return [field.type for field in kind.fields if field.encode_name == key]
    if isinstance(kind, inspect.TupleType) and index:
        position = int(index) if index.isdigit() else 0
        return list(kind.item_types[position : position + 1])
    if isinstance(kind, inspect.VarTupleType) and index:
        return [kind.item_type]
    if isinstance(kind, inspect.DictType):
        return [kind.value_type]
    return []


@lru_cache(maxsize=64)
def derived_struct(shape: Hashable, fields: tuple[tuple[str, Any], ...]) -> type[Any]:
    """Return a struct type derived from `shape`, in which some fields have other types but equal defaults."""
    assert isinstance(shape, type)
    defaults = {one.name: one.default for one in msgspec.structs.fields(shape)}
    given = [
        (name, kind) if defaults[name] is msgspec.NODEFAULT else (name, kind, defaults[name])
        for name, kind in fields
    ]
    return msgspec.defstruct(shape.__name__, given, bases=(shape,), frozen=True, kw_only=True)


Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]
Share = Annotated[float, Meta(gt=0.0, le=1.0)]
Longitude = Annotated[float, Meta(ge=-360.0, le=360.0)]
Latitude = Annotated[float, Meta(ge=-90.0, le=90.0)]
Q2 = Annotated[float, Meta(ge=-Q2_LIMIT, le=Q2_LIMIT)]
Address = Annotated[int, Meta(ge=0x08, le=0x77)]
Bus = (
    Annotated[int, Meta(ge=0, le=0xFFFFF)]
    | Annotated[
        str, Meta(pattern=r"^/[A-Za-z0-9_./:+-]+$", description="the number of a bus, or its device file")
    ]
)
CallSign = Annotated[
    str,
    Meta(
        pattern=r"^[A-Z0-9]{1,6}(-([0-9]|1[0-5]))?$",
        description="an amateur call sign of capitals and digits with an SSID from 0 to 15, such as OK0SAT-1",
    ),
]
Peer = Annotated[
    str,
    Meta(
        pattern=r"^[0-9]{1,3}(\.[0-9]{1,3}){3}(/[0-9]{1,2})?$",
        description="an IPv4 address or subnet, such as 192.168.7.0/24",
    ),
]
HostPort = Annotated[
    str,
    Meta(
        pattern=r"^[^:\s]+:([0-5]?[0-9]{1,4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])$",
        description="HOST:PORT, such as 127.0.0.1:5005, PORT 65535 at most",
    ),
]
Sign = Literal[-1, 1]
SignedAxis = Literal["x", "y", "z", "-x", "-y", "-z"]
DriverName = Annotated[str, Meta(min_length=1, max_length=200)]
"""Name of a driver in `flight.schema.devices`, or `module:object`."""
Channel = Annotated[int, Meta(ge=0, le=15)]
BaudRate = Literal[9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600]
Estimator = Literal["likelihood", "harris", "minimum-eigenvalue", "trajkovic-4", "trajkovic-8"]
Vector = tuple[float, float, float]
Inertia = tuple[float | Vector, float | Vector, float | Vector]
"""Three moments of inertia about the body axes, or the three rows of the inertia tensor, kg m^2. The function
`inertia_problem` checks the moments. Bounds in this type would damage memory: msgspec 0.22 cannot distinguish
a number with a bound from a tuple of fixed length."""
Quaternion = tuple[float, float, float, float]
PlainMode = Literal["testbed-demo", "hold", "detumble", "safe"]
CommandedMode = Literal[PlainMode, "sun", "point"]
GoalName = Literal["nadir", "velocity", "sun", "inertial", "ground", "object"]

_OWN = {
    "inertial": ("quaternion",),
    "ground": ("latitude_deg", "longitude_deg"),
    "object": ("right_ascension_deg", "declination_deg"),
}
"""Keys that a goal requires and no other goal accepts. The goal `object` may have both keys or none."""
_LENGTH_ERROR = 1e-3
"""Largest accepted deviation of a commanded quaternion's norm from 1."""


def inertia_matrix(inertia: Inertia) -> FloatArray:
    """Return the inertia tensor (3, 3), kg m^2. Raises ValueError if moments are mixed with matrix rows."""
    given = np.array(inertia, dtype=float)
    return np.diag(given) if given.ndim == 1 else given


class Section(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A section of the configuration, in which unknown keys are errors."""


class Aim(Section, frozen=True, kw_only=True):
    """The values that describe a pointing goal.

    The goal `inertial` requires `quaternion` (ICRS to body, scalar last), and `ground` requires latitude and
    longitude. For the goal `object`, right ascension and declination give the direction of the search. If
    `roll_deg` is omitted, the roll angle is free.
    """

    quaternion: Quaternion | None = None
    latitude_deg: Latitude | None = None
    longitude_deg: Longitude | None = None
    right_ascension_deg: Longitude | None = None
    declination_deg: Latitude | None = None
    roll_deg: Longitude | None = None

    def target_at(self, goal: str) -> PointingTarget:
        """Return the pointing target for a goal. Raises UsageError for missing and superfluous values."""
        angles = (self.latitude_deg, self.longitude_deg, self.right_ascension_deg, self.declination_deg)
        numbers = tuple(math.radians(value) for value in angles if value is not None)
        roll = None if self.roll_deg is None else math.radians(self.roll_deg)
        return PointingTarget(Goal.named(goal), (*numbers, *(self.quaternion or ())), roll)


def check_aim(dotted: str, aim: Aim, goal: str | None, refuse: Callable[[str, str], None]) -> None:
    """Report missing values, values of other goals, and values without a goal through `refuse`."""
    for owner, names in _OWN.items():
        needed = owner == goal and (
            owner != "object" or any(getattr(aim, name) is not None for name in names)
        )
        for name in names:
            given = getattr(aim, name) is not None
            if given and goal != owner:
                refuse(f"{dotted}.{name}", f"belongs to `point: {owner}`, not to {goal or 'this command'}")
            if not given and needed:
                refuse(f"{dotted}.point", f"is {goal}: needs `{name}`")
    if aim.roll_deg is not None and (goal is None or Goal.named(goal) in ROLLS):
        refuse(f"{dotted}.roll_deg", ROLLS[Goal.named(goal)] if goal else "belongs to `point`")
    if aim.quaternion is not None and abs(math.hypot(*aim.quaternion) - 1.0) > _LENGTH_ERROR:
        length = math.hypot(*aim.quaternion)
        refuse(f"{dotted}.quaternion", f"has length {length:.6g}: a quaternion must have length 1")
