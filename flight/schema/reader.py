"""Reading a configuration: YAML in, a validated `flight.schema.sections.Config` out, or one clear line.

Every complaint names the file, the line, the value and what would be right; an unknown key is answered with
the nearest right one. Numbers follow YAML 1.2 (1e-5 is a number); keys may stand only once; NaN is refused.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import yaml

from flight.schema.errors import ConfigError
from flight.schema.peers import peer_networks
from flight.schema.sections import Camera, Commands, Config

T = TypeVar("T")
S = TypeVar("S", bound=msgspec.Struct)
Lines = dict[str, int]

_LONGEST = 1 << 20
_FLOAT = re.compile(
    r"^[-+]?(\.[0-9]+|[0-9]+\.[0-9]*|[0-9]+(?=[eE]))([eE][-+]?[0-9]+)?$"
    r"|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"
)


class _Loader(yaml.SafeLoader):
    """YAML's safe loader with the numbers of YAML 1.2: pyyaml alone takes 1e-5 for a word."""

    yaml_implicit_resolvers = {  # noqa: RUF012 - the shape pyyaml wants
        first: [entry for entry in entries if entry[0] != "tag:yaml.org,2002:float"]
        for first, entries in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Return the next value; refuse an alias: a few lines of them can say more than memory holds."""
        if self.check_event(yaml.AliasEvent):
            mark = self.get_event().start_mark  # type: ignore[no-untyped-call]  # its stubs lack types
            raise yaml.composer.ComposerError(None, None, "an alias (*): write the value out", mark)
        return super().compose_node(parent, index)


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789."))


def load(path: Path) -> Config:
    """Read and validate a configuration file. Raises ConfigError."""
    return parse(_read(path), str(path))


def parse(text: str, name: str = "configuration") -> Config:
    """Validate configuration text; `name` stands for the file in complaints. Raises ConfigError."""
    tree, lines = _read_yaml(text, name)
    for fitted_or_not in ("camera", "power_monitor"):
        if tree.get(fitted_or_not) == "none":
            tree[fitted_or_not] = None
    config = convert(tree, Config, name, lines)
    _check_sense(config, name, lines)
    return config


def load_camera(path: Path) -> Camera:
    """Read the camera of a whole configuration, or of a file that holds nothing but a `camera` section.

    Raises ConfigError, also when there is no camera.
    """
    text = _read(path)
    tree, lines = _read_yaml(text, str(path))
    if set(tree) == {"camera"} and tree["camera"] != "none":
        return convert(tree["camera"], Camera, str(path), lines, prefix="camera")
    camera = parse(text, str(path)).camera
    if camera is None:
        raise ConfigError(str(path), "`camera` is none: give a configuration with a camera")
    return camera


def load_whole(path: Path, shape: type[T]) -> T:
    """Read a file that is one `shape` and nothing else. Raises ConfigError."""
    tree, lines = _read_yaml(_read(path), str(path))
    return convert(tree, shape, str(path), lines)


def simulation_section(text: str, name: str, shape: type[T]) -> T | None:
    """Return the `simulation` section of configuration text as `shape`, None when there is none.

    The section's shape belongs to the simulator, which this package does not know. Raises ConfigError.
    """
    tree, lines = _read_yaml(text, name)
    if tree.get("simulation") is None:
        return None
    return convert(tree["simulation"], shape, name, lines, prefix="simulation")


def replace(section: S, **changes: Any) -> S:
    """Return a section with some values changed."""
    return msgspec.structs.replace(section, **changes)


def convert(tree: Any, shape: type[T], name: str, lines: Lines, prefix: str = "") -> T:
    """Turn plain YAML values into `shape`, naming file, line and value in any complaint."""
    try:
        return msgspec.convert(tree, shape)
    except msgspec.ValidationError as error:
        message, _, path = str(error).partition(" - at `$")
        dotted = _join(prefix, path.rstrip("`").lstrip("."))
        unknown = re.match(r"Object contains unknown field `(.+)`", message)
        if unknown:
            dotted = _join(dotted, unknown.group(1))
            message = "is an unknown key" + _nearest(unknown.group(1), shape, tree, path.rstrip("`"))
        else:
            value = _lookup(tree, path.rstrip("`"))
            message = (
                f"is {_shown(value)}: {message[0].lower()}{message[1:]}" if value is not _ABSENT else message
            )
        raise ConfigError(_place(name, dotted, lines), f"`{dotted or 'configuration'}` {message}") from error


def _shown(value: Any) -> str:
    """Return a value as a complaint shows it: one that fills the screen is cut."""
    text = repr(value)
    return text if len(text) <= 200 else text[:200] + "..."


def _read(path: Path) -> str:
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(_LONGEST + 1)  # a device may have no end
        if len(text) > _LONGEST:
            raise ConfigError(str(path), f"has more than {_LONGEST} characters: no configuration has")
        return text
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(str(path), f"cannot be read: {error}") from error


def _read_yaml(text: str, name: str) -> tuple[dict[str, Any], Lines]:
    """Return the plain values and the line of every dotted name."""
    lines: Lines = {}
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        _walk(node, "", lines, name)
        tree = loader.construct_document(node) if node is not None else None
    # pyyaml's own constructors raise these for a tag that a value does not fit, such as `!!timestamp name`.
    except (yaml.YAMLError, ValueError, AttributeError, TypeError, OverflowError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{name}:{mark.line + 1}" if mark else name
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ConfigError(where, f"is not YAML: {problem}") from error
    except RecursionError as error:
        raise ConfigError(name, "is nested too deeply") from error
    if not isinstance(tree, dict):
        raise ConfigError(name, "must be a mapping of sections, see config/step_demo.yaml")
    _refuse_not_finite(tree, "", name, lines)
    return tree, lines


def _walk(node: yaml.Node | None, dotted: str, lines: Lines, name: str) -> None:
    """Note the line of every value; refuse a key that stands twice (pyyaml would keep the last)."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            child = _join(dotted, str(key.value))
            if child in lines:
                where = f"{name}:{key.start_mark.line + 1}"
                raise ConfigError(where, f"`{child}` stands twice, first in line {lines[child]}")
            lines[child] = key.start_mark.line + 1
            _walk(value, child, lines, name)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            lines[f"{dotted}[{index}]"] = value.start_mark.line + 1
            _walk(value, f"{dotted}[{index}]", lines, name)


def _refuse_not_finite(value: Any, dotted: str, name: str, lines: Lines) -> None:
    if isinstance(value, dict):
        for key, child in value.items():
            _refuse_not_finite(child, _join(dotted, str(key)), name, lines)
    elif isinstance(value, list):
        for index, child in enumerate(value):
            _refuse_not_finite(child, f"{dotted}[{index}]", name, lines)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(_place(name, dotted, lines), f"`{dotted}` is {value!r}: must be a finite number")


PIXEL_BITS = {
    "GREY": range(8, 9),
    "Mono8": range(8, 9),
    "Y10": range(10, 11),
    "Mono10": range(10, 11),
    "Y12": range(12, 13),
    "Mono12": range(12, 13),
    "Y16": range(9, 17),
    "Mono16": range(9, 17),
}
"""Of a camera's pixel formats; those of 16 may be filled by a converter of fewer."""

_ABSENT = object()


def _lookup(tree: Any, path: str) -> Any:
    """Return the value at a msgspec path such as `.coils.channels[1]`."""
    for key, index in re.findall(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]", path):
        try:
            tree = tree[key] if key else tree[int(index)]
        except (KeyError, IndexError, TypeError, ValueError):
            return _ABSENT
    return tree if not isinstance(tree, dict) else _ABSENT


def _nearest(key: str, shape: Any, tree: Any, path: str) -> str:
    """Suggest the right name for an unknown key of the struct found along `path`."""
    for step in re.findall(r"\.([^.\[]+)", path):
        fields = {f.encode_name: f.type for f in msgspec.structs.fields(shape)}
        tree = tree.get(step) if isinstance(tree, dict) else None
        shape = _struct_of(fields.get(step), tree)
        if shape is None:
            return ""
    names = [f.encode_name for f in msgspec.structs.fields(shape)]
    close = difflib.get_close_matches(key, names, n=1, cutoff=0.5)
    return f", did you mean `{close[0]}`?" if close else f"; known keys: {', '.join(names)}"


def _struct_of(annotation: Any, tree: Any) -> Any:
    """Return the struct inside an annotation such as `Camera | None` or `tuple[Step, ...]`.

    Of several that a tag tells apart it is the one whose tag stands in `tree`.
    """
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        config = annotation.__struct_config__
        told = tree.get(config.tag_field) if isinstance(tree, dict) and config.tag_field else config.tag
        return annotation if told == config.tag else None
    for inner in getattr(annotation, "__args__", ()):
        if (found := _struct_of(inner, tree)) is not None:
            return found
    return None


def _span(numbers: range) -> str:
    return f"{numbers[0]}" if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"


def _join(prefix: str, key: str) -> str:
    return f"{prefix}.{key}" if prefix and key and not key.startswith("[") else prefix + key


def _place(name: str, dotted: str, lines: Lines) -> str:
    """Return file:line of the value or of the nearest section above it."""
    while dotted and dotted not in lines:
        dotted = re.sub(r"(\.[^.\[]+|\[[^\]]*\]|^[^.\[]+)$", "", dotted)
    return f"{name}:{lines[dotted]}" if dotted else name


def _check_sense(config: Config, name: str, lines: Lines) -> None:
    """Refuse values that are each possible but make no sense together."""

    def refuse(dotted: str, problem: str) -> None:
        raise ConfigError(_place(name, dotted, lines), f"`{dotted}` {problem}")

    times = [step.at for step in config.steps]
    if times[0] != 0.0:
        refuse("steps[0].at", f"is {times[0]!r}: the first target must be given at 0")
    for index in range(1, len(times)):
        if times[index] <= times[index - 1]:
            refuse(f"steps[{index}].at", f"is {times[index]!r}: targets must stand in order of time")
    if config.duration <= times[-1]:
        refuse("duration", f"is {config.duration!r}: the last target is given at {times[-1]!r} s")
    _check_commands(config.commands, refuse)
    used = [c for pair in config.coils.channels for c in pair] + list(config.coils.enable_channels or ())
    if len(set(used)) != len(used):
        refuse("coils.channels", f"{used} use a channel of the PWM chip twice")
    if config.power_monitor is not None and config.power_monitor.address == config.coils.address:
        refuse(
            "power_monitor.address",
            f"is 0x{config.power_monitor.address:02x}, the PWM chip's: both leave the factory at 0x40, "
            "set the monitor's address pins (0x45) and say so here",
        )
    # A reading waits for its cycle, and the current that it leads to flows until the next.
    unit = config.inertial_unit
    least = 1.0 / unit.rate_hz + 2.0 / config.executive.control_rate_hz
    if unit.max_age < least:
        problem = f"is {unit.max_age!r}: at the rates of unit and control it must be {least:g} s at least"
        refuse("inertial_unit.max_age", problem)
    if config.guidance.replan_period >= config.guidance.horizon:
        refuse("guidance.replan_period", "must be shorter than `guidance.horizon`")
    if config.camera is not None:
        _check_camera(config.camera, refuse)
    for dotted, quaternion in (
        ("inertial_unit.mounting", config.inertial_unit.mounting),
        ("camera.mounting", config.camera.mounting if config.camera else (0.0, 0.0, 0.0, 1.0)),
    ):
        norm = math.sqrt(sum(c * c for c in quaternion))
        if abs(norm - 1.0) > 1e-6:
            refuse(dotted, f"has length {norm:.6g}: a quaternion must have length 1")


def _check_commands(commands: Commands, refuse: Callable[[str, str], None]) -> None:
    for index, step in enumerate(commands.timeline):
        given = [name for name in ("mode", "slew", "clear") if getattr(step, name) is not None]
        if len(given) != 1:
            refuse(f"commands.timeline[{index}]", f"gives {given}: must give one of mode, slew, clear")
    try:
        peer_networks(commands)
    except ValueError as error:
        refuse("commands.peers" if commands.peers else "commands.udp", str(error))


def _check_camera(camera: Camera, refuse: Callable[[str, str], None]) -> None:
    if camera.exposure >= camera.period:
        refuse("camera.exposure", "must be shorter than `camera.period`")
    if camera.device is not None:
        pixel_format, possible = camera.device.pixel_format, PIXEL_BITS[camera.device.pixel_format]
        if camera.bits not in possible:
            refuse("camera.bits", f"is {camera.bits}: pixels of {pixel_format} have {_span(possible)}")
