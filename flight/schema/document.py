"""A YAML file as plain values, with the line of each for complaints.

Numbers follow YAML 1.2 (1e-5 is one). Aliases, duplicate keys and numbers that are not finite are refused.
"""

from __future__ import annotations

import io
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, ComposerError
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent
from ruamel.yaml.nodes import MappingNode, Node, SequenceNode

from flight.schema.carried import names
from flight.schema.errors import ConfigError, UnreadConfigError

_LONGEST = 1 << 20


@dataclass(frozen=True, slots=True)
class Document:
    """The values of a file, its name, and the lines of the values by dotted name, as `steps[1].at`."""

    values: dict[str, Any]
    name: str
    lines: dict[str, int]

    def error(self, dotted: str, problem: str) -> ConfigError:
        """Return the complaint about a value, with its line or that of the nearest section above it."""
        known = dotted
        while known and known not in self.lines:
            known = re.sub(r"(\.[^.\[]+|\[[^\]]*\]|^[^.\[]+)$", "", known)
        where = f"{self.name}:{self.lines[known]}" if known else self.name
        return ConfigError(where, f"`{dotted or 'configuration'}` {problem}")


def read_text(path: Path) -> str:
    """Return the text of a file. Raises ConfigError when it cannot be read or is longer than 1 MiB."""
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(_LONGEST + 1)  # a device may have no end
    except FileNotFoundError as error:
        raise UnreadConfigError(str(path), f"cannot be read: {no_such_file()}") from error
    except OSError as error:
        raise UnreadConfigError(str(path), f"cannot be read: {error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), f"cannot be read: {error}") from error
    return checked_length(text, path)


def no_such_file() -> str:
    """Return the complaint about a file that is not there, with the names that would be right."""
    return f"no such file; by name there are {', '.join(names())}"


def checked_length(text: str, path: Path) -> str:
    """Return the text of a file. Raises ConfigError when it is longer than 1 MiB."""
    if len(text) > _LONGEST:
        raise ConfigError(str(path), f"is longer than {_LONGEST} characters")
    return text


def read_document(text: str, name: str) -> Document:
    """Return the values of YAML text; `name` stands for the file in complaints. Raises ConfigError."""
    lines: dict[str, int] = {}
    yaml = YAML(typ="safe", pure=True)
    yaml.Composer = _Composer
    try:
        node = yaml.compose(text)
        _note_lines(node, "", lines, name)
        values = None if node is None else yaml.constructor.construct_document(node)
    except RecursionError as error:
        raise ConfigError(name, "is nested too deeply") from error
    # The others come from a value that does not fit its explicit tag, such as `!!int x`.
    except (YAMLError, ValueError, LookupError, ArithmeticError, AttributeError, TypeError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{name}:{mark.line + 1}" if mark else name
        problem = getattr(error, "problem", None) or str(error)
        raise ConfigError(where, f"is not YAML: {problem.splitlines()[0]}") from error
    if not isinstance(values, dict):
        raise ConfigError(name, "must be a mapping of sections, see config/step_demo.yaml")
    document = Document(values, name, lines)
    _refuse_not_finite(values, "", document)
    return document


def to_yaml(values: dict[str, Any]) -> str:
    """Return plain values as YAML text, in their order."""
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # its annotation is of None
    text = io.StringIO()
    yaml.dump(values, text)
    return text.getvalue()


def join(prefix: str, key: str) -> str:
    """Return the dotted name of a key, or of an index in brackets, under a prefix."""
    return f"{prefix}.{key}" if prefix and key and not key.startswith("[") else prefix + key


class _Composer(Composer):
    """Refuses aliases: a few lines of them can stand for more values than memory holds."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return the next node."""
        if self.parser.check_event(AliasEvent):
            mark = self.parser.get_event().start_mark
            raise ComposerError(None, None, "an alias (*): write the value out", mark)
        return super().compose_node(parent, index)


def _note_lines(node: Node | None, dotted: str, lines: dict[str, int], name: str) -> None:
    """Note the line of every value; refuse a duplicate key."""
    if isinstance(node, MappingNode):
        for key, value in node.value:
            child = join(dotted, str(key.value))
            line = key.start_mark.line + 1
            if child in lines:
                raise ConfigError(f"{name}:{line}", f"`{child}` stands twice, first in line {lines[child]}")
            lines[child] = line
            _note_lines(value, child, lines, name)
    elif isinstance(node, SequenceNode):
        for index, value in enumerate(node.value):
            lines[f"{dotted}[{index}]"] = value.start_mark.line + 1
            _note_lines(value, f"{dotted}[{index}]", lines, name)


def _refuse_not_finite(value: Any, dotted: str, document: Document) -> None:
    if isinstance(value, dict):
        for key, child in value.items():
            _refuse_not_finite(child, join(dotted, str(key)), document)
    elif isinstance(value, list):
        for index, child in enumerate(value):
            _refuse_not_finite(child, f"{dotted}[{index}]", document)
    elif isinstance(value, float) and not math.isfinite(value):
        raise document.error(dotted, f"is {value!r}: must be a finite number")
