"""Tests that configurations with random wrong values are usable, or are refused in one line."""

from __future__ import annotations

import math
from random import Random
from typing import Any

import msgspec
import numpy as np
import pytest
import yaml
from hypothesis import given, settings

from flight.app.devices import coil_settings, unit_settings
from flight.app.flight import workers
from flight.schema import reader as configuration
from flight.schema.document import FOLDER, ConfigError
from hal.interfaces.errors import DeviceError
from sim_hal.settings import Simulation
from tests.support.damaged import chances, damage
from tests.support.flights import CONFIG

TREES = [yaml.safe_load(path.read_text(encoding="utf-8")) for path in sorted(CONFIG.parent.glob("*.yaml"))]
SCALARS: tuple[Any, ...] = (
    0, -1, 1, 7, 2**31, -(2**63), 2**64, 10**400, 0.0, -0.0, 1e-320, 1e308, -1e308, 0.5, math.nan, math.inf,
    -math.inf, True, False, None, "", "none", "nan", "1e5", "0x40", "hold", "\0", "é" * 70, "x" * 5000, [],
    {}, [0.0, 0.0, 0.0, 1.0], [1, 2, 3], [[0, 1], [2, 3], [4, 5]], [math.nan] * 4, {"a": 1}, [[]] * 3,
)  # fmt: skip
FACTORS = (-1, 0, 2, 10, 1e-3, 1e3, 1e9, 0.999)


def spoil(chance: Random, node: Any) -> None:
    """Change one random value in a tree of values."""
    while True:
        key = chance.choice(list(node) if isinstance(node, dict) else list(range(len(node))))
        below = node[key]
        if not (isinstance(below, dict | list) and below and chance.random() < 0.8):
            break
        node = below
    kind = chance.randrange(5)
    if kind == 0:
        del node[key]
    elif kind == 1 and isinstance(node, dict):
        node[f"{key}x"] = node.pop(key)
    elif kind == 2 and type(below) in {int, float} and abs(below) < 1e300:
        node[key] = below * chance.choice(FACTORS)
    else:
        node[key] = chance.choice(SCALARS)


def assert_finite(value: Any) -> None:
    """Assert that all numbers in a tree of values are finite."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            assert_finite(item)
    assert not isinstance(value, float) or math.isfinite(value)


@settings(max_examples=40)
@given(chance=chances())
def test_a_damaged_configuration_is_refused_in_one_line_or_usable(chance: Random) -> None:
    tree = chance.choice(TREES)
    text = yaml.safe_dump({**tree, "camera": "none"} if chance.random() < 0.8 else tree)
    if chance.random() < 0.5:
        changed = yaml.safe_load(text)
        for _ in range(chance.randint(1, 3)):
            spoil(chance, changed)
        text = yaml.safe_dump(changed)
    else:
        text = damage(chance, text.encode()).decode("utf-8", "replace")
    try:
        config = configuration.parse(text, "damaged.yaml")
        if config.simulation is not None:
            configuration.simulation_section(text, "damaged.yaml", Simulation)
        coils, unit = coil_settings(config.coils), unit_settings(config.inertial_unit)
        workers(config)
    except ConfigError as error:
        message = str(error)
        assert message.startswith(("damaged.yaml", str(FOLDER))), "or the file that it extends"
        assert "\n" not in message
        assert len(message) < 8000
        return
    except DeviceError:  # a driver refuses a setting of this configuration
        return
    assert_finite(msgspec.to_builtins(config))
    assert msgspec.convert(msgspec.to_builtins(config), type(config)) == config
    assert 0.0 < coils.current_limit < math.inf
    assert unit.mounting @ unit.mounting.T == pytest.approx(np.eye(3), abs=1e-5)
