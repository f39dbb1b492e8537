"""Mutated configurations, as text and as trees, through the reader.

Accepted corruption is: a value that is not of its type, not within its bounds, or not finite, judged here by
a walk of its own over the annotations; a configuration that does not survive being written and read again;
one from which the plant, the coils and the inertial unit cannot be set up.
"""

from __future__ import annotations

import math
import types
import typing
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from flight.schema import reader as configuration
from flight.schema.document import ConfigError
from flight.schema.orbit import OrbitConfig
from flight.schema.sections import Config
from flight.schema.testbed import TestbedConfig
from hal.interfaces.errors import DeviceError
from sim_hal.settings import Simulation
from tests.studies.fuzz.harness import Finding
from tests.studies.fuzz.mutation import Draw, chance, damage, integer

FOLDER = Path(__file__).resolve().parents[3] / "config"

_SHAPES: tuple[type[Config], ...] = (TestbedConfig, OrbitConfig)
_SECTIONS = {"body"} | {
    field.name for shape in _SHAPES for field in msgspec.structs.fields(shape) if field.required
}
_NEEDED = {
    (section.name, field.name)
    for shape in _SHAPES
    for section in msgspec.structs.fields(shape)
    if isinstance(section.type, type) and issubclass(section.type, msgspec.Struct)
    for field in msgspec.structs.fields(section.type)
    if field.required
}
_SCALARS: tuple[Any, ...] = (
    0, -1, 1, 7, 2**31, -(2**63), 2**64, 10**400, 0.0, -0.0, 1e-320, 1e308, -1e308, 0.5, math.nan, math.inf,
    -math.inf, True, False, None, "", "none", "nan", "1e5", "0x40", "hold", "\0", "é" * 70, "x" * 5000, [],
    {}, [0.0, 0.0, 0.0, 1.0], [1, 2, 3], [[0, 1], [2, 3], [4, 5]], [math.nan] * 4, {"a": 1}, [[]] * 3,
)  # fmt: skip
_TEXTS = (
    "\t", ": ", "- ", "#", "\n", "'", '"', "{", "}", "[", "]", "&a ", "*a", "!!python/object:os.system ",
    "!!float ", "!!binary ", "!!set ", "!!timestamp ", "<<: ", "---\n", "...\n", "%YAML 9.9\n", "? ", "| ",
    "> ", ".nan", ".inf", "1e999", "-0", "0o17", "1_000", "2026-01-01", "2026-99-99 99:99:99", "~", "null",
    "yes", "=", "\u2028", "\ufeff", "\0", "\x85", "camera: none\n", "duration: 1\n", "a: &a [*a]\n",
    "99999999999999999999", "12:30:45", "0b2", "@",
)  # fmt: skip


class Configurations:
    """The target."""

    def __init__(self) -> None:
        self._texts = [path.read_text(encoding="utf-8") for path in sorted(FOLDER.glob("*.yaml"))]
        self._trees = [yaml.safe_load(text) for text in self._texts]
        self._text = ""

    def last(self) -> str:
        """Return the last text."""
        return self._text

    def attempt(self, draw: Draw) -> Counter[str]:
        """Read one configuration."""
        which = integer(draw, 0, len(self._texts) - 1)
        structural = chance(draw, 0.5)
        tree = _excerpt(draw, self._trees[which])
        if structural:
            self._text = _written(_damaged_tree(draw, tree))
        else:
            whole = chance(draw, 0.02)
            self._text = _damaged_text(draw, self._texts[which] if whole else _written(tree))
        tally = Counter({"trees" if structural else "texts": 1})
        try:
            config = configuration.parse(self._text, "fuzz.yaml")
            section = None
            if config.simulation is not None:
                section = configuration.simulation_section(self._text, "fuzz.yaml", Simulation)
        except ConfigError as error:
            message = str(error)
            if "\n" in message or not message.startswith("fuzz.yaml") or len(message) > 8000:
                raise Finding(f"a complaint that is not one clear line: {message[:200]!r}") from error
            return tally + Counter(refused=1)
        for value, shape in ((config, type(config)), (section, Simulation | None)):
            judge(value, shape, "")
        if msgspec.convert(msgspec.to_builtins(config), type(config)) != config:
            raise Finding("a configuration that does not survive being written")
        try:
            _set_up(config)
        except DeviceError:  # beyond what the parts can do: one clear line too
            return tally + Counter(refused_by_driver=1)
        return tally + Counter(accepted=1)


def _excerpt(draw: Draw, tree: dict[str, Any]) -> dict[str, Any]:
    """Return what must be there and some of the rest: short texts are read faster."""
    kept = {
        name: {key: item for key, item in section.items() if (name, key) in _NEEDED or chance(draw, 0.3)}
        if isinstance(section, dict) and name not in {"camera", "simulation"}
        else section
        for name, section in tree.items()
        if name in _SECTIONS or chance(draw, 0.05 if name == "simulation" else 0.15)
    }
    if chance(draw, 0.8):
        kept["camera"] = "none"
    return {**kept, "steps": tree["steps"][:2]} if "steps" in tree else kept


def _set_up(config: Config) -> None:
    """Make of a configuration what a flight makes of it first."""
    from flight.app.composition import workers  # noqa: PLC0415
    from flight.app.devices import coil_settings, unit_settings  # noqa: PLC0415 - the whole flight hangs on it
    from flight.bodies.testbed.control import plant_of  # noqa: PLC0415

    coils, unit = coil_settings(config), unit_settings(config)
    workers(config)
    numbers: tuple[float, ...] = (coils.current_limit,)
    if isinstance(config, TestbedConfig):
        plant = plant_of(config)
        numbers += (plant.inertia, plant.torque_constant, plant.resistance, plant.current_limit)
    elif isinstance(config, OrbitConfig):
        numbers += (*config.craft.inertia, config.craft.dipole_per_ampere)
    if not all(0.0 < number < math.inf for number in numbers):
        raise Finding(f"a body that cannot be: {numbers}")
    if not np.allclose(unit.mounting @ unit.mounting.T, np.eye(3), atol=1e-5):
        raise Finding("a mounting that is no rotation")


def judge(value: Any, shape: Any, name: str) -> None:
    """Raise Finding unless `value` is what the annotation `shape` allows: types, bounds, finite numbers."""
    bounds: list[msgspec.Meta] = []
    while typing.get_origin(shape) is typing.Annotated:
        bounds += [meta for meta in shape.__metadata__ if isinstance(meta, msgspec.Meta)]
        shape = shape.__origin__
    origin, parts = typing.get_origin(shape), typing.get_args(shape)
    if origin in {types.UnionType, typing.Union}:
        _judge_any(value, parts, name)
    elif origin is typing.Literal:
        _require(value in parts, name, value)
    elif origin is tuple:
        _require(isinstance(value, tuple), name, value)
        kinds = [parts[0]] * len(value) if parts[1:] == (...,) else parts
        _require(len(kinds) == len(value), name, value)
        for index, (item, kind) in enumerate(zip(value, kinds, strict=True)):
            judge(item, kind, f"{name}[{index}]")
    elif origin is dict or shape is Any:
        _judge_plain(value, name)
    elif isinstance(shape, type) and issubclass(shape, msgspec.Struct):
        _require(type(value) is shape, name, value)
        for field, kind in typing.get_type_hints(shape, include_extras=True).items():
            judge(getattr(value, field), kind, f"{name}.{field}")
    elif shape is type(None):
        _require(value is None, name, value)
    else:
        _require(type(value) is shape, name, value)
        _require(not isinstance(value, float) or math.isfinite(value), name, value)
    for meta in bounds:
        _require(_within(value, meta), name, value)


def _judge_any(value: Any, kinds: tuple[Any, ...], name: str) -> None:
    failures = []
    for kind in kinds:
        try:
            return judge(value, kind, name)
        except Finding as finding:
            failures.append(finding)
    # The failure inside the alternative that was meant says more than that another one is not meant.
    raise next((failure for failure in failures if not str(failure).startswith(f"{name} = ")), failures[-1])


def _judge_plain(value: Any, name: str) -> None:
    """Look for numbers that are not finite in what has no shape here."""
    if isinstance(value, dict):
        for key, item in value.items():
            _judge_plain(item, f"{name}.{key}")
    elif isinstance(value, list):
        for item in value:
            _judge_plain(item, name)
    _require(not isinstance(value, float) or math.isfinite(value), name, value)


def _within(value: Any, meta: msgspec.Meta) -> bool:
    size = len(value) if isinstance(value, (str, tuple, dict)) else 0
    return all(
        (
            meta.gt is None or value > meta.gt,
            meta.ge is None or value >= meta.ge,
            meta.lt is None or value < meta.lt,
            meta.le is None or value <= meta.le,
            meta.min_length is None or size >= meta.min_length,
            meta.max_length is None or size <= meta.max_length,
        )
    )


def _require(holds: bool, name: str, value: Any) -> None:
    if not holds:
        raise Finding(f"{name} = {value!r}"[:300])


def _damaged_text(draw: Draw, text: str) -> str:
    """Return text with some things wrong."""
    for _ in range(integer(draw, 1, 4)):
        lines = text.splitlines(keepends=True) or [""]
        at = integer(draw, 0, len(lines) - 1)
        kind = integer(draw, 0, 6)
        if kind == 0:
            del lines[at]
        elif kind == 1:
            lines.insert(integer(draw, 0, len(lines)), lines[at])
        elif kind == 2:
            lines[at] = " " * integer(draw, 0, 6) + lines[at].lstrip()
        elif kind == 3:
            key, colon, _ = lines[at].partition(":")
            lines[at] = f"{key}{colon} {_scalar_text(draw)}\n"
        elif kind == 4:
            lines[at] = damage(draw, lines[at].encode()).decode("utf-8", "replace")
        else:
            place = integer(draw, 0, len(lines[at]))
            lines[at] = lines[at][:place] + _TEXTS[integer(draw, 0, len(_TEXTS) - 1)] + lines[at][place:]
        text = "".join(lines)
    return _bomb(draw) + text if chance(draw, 0.02) else text


def _bomb(draw: Draw) -> str:
    """Return a few lines that say a great deal: aliases of aliases."""
    depth = integer(draw, 3, 30)
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, depth)]
    return "\n".join(lines) + "\n"


def _scalar_text(draw: Draw) -> str:
    scalar = _SCALARS[integer(draw, 0, len(_SCALARS) - 1)]
    return repr(scalar) if chance(draw, 0.5) else str(scalar)


def _damaged_tree(draw: Draw, tree: Any) -> Any:
    """Return a copy of plain values with some of them wrong."""
    tree = _copy(tree)
    for _ in range(integer(draw, 1, 3)):
        node, steps = tree, integer(draw, 1, 5)
        for step in range(steps):
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            if not keys:
                break
            key = keys[integer(draw, 0, len(keys) - 1)]
            below = node[key]
            if step < steps - 1 and isinstance(below, (dict, list)) and below:
                node = below
                continue
            _spoil(draw, node, key)
            break
    return tree


def _spoil(draw: Draw, node: Any, key: Any) -> None:
    kind = integer(draw, 0, 5)
    value = node[key]
    if kind == 0:
        del node[key]
    elif kind == 1 and isinstance(node, dict):
        node[("" if key is None else str(key)) + "x"] = node.pop(key)
    elif kind <= 3 and type(value) in {int, float} and abs(value) < 1e300:
        node[key] = value * (-1, 0, 2, 10, 1e-3, 1e3, 1e9, 0.999)[integer(draw, 0, 7)]
    else:
        node[key] = _copy(_SCALARS[integer(draw, 0, len(_SCALARS) - 1)])


def _copy(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _copy(item) for key, item in tree.items()}
    return [_copy(item) for item in tree] if isinstance(tree, list) else tree


def _written(tree: Any) -> str:
    """Return a tree as YAML, in the form that is fastest to write."""
    dumper = yaml.CSafeDumper if hasattr(yaml, "CSafeDumper") else yaml.SafeDumper
    text: str = yaml.dump(tree, Dumper=dumper, default_flow_style=None, width=1000)
    return text
