"""The configuration of an order: its file, with what the order changes in it."""

from __future__ import annotations

import numpy as np

from flight.app.request import Order
from flight.app.simulated import corrupted_text
from flight.gnc.errors import UsageError
from flight.schema import reader as configuration
from flight.schema.sections import Config


def ordered_config(order: Order) -> tuple[str, Config]:
    """Return the configuration as text and as values, with the order's changes in the values.

    Raises ConfigError for the file's mistakes, UsageError for the order's.
    """
    config = configuration.load(order.config_path)
    text = order.config_path.read_text(encoding="utf-8")
    if order.faults and config.simulation is None:
        raise UsageError("--fault: this configuration flies real devices, which break by themselves")
    if order.faults:
        spoiled = corrupted_text(order, text)
        if spoiled != text:
            text, config = spoiled, configuration.parse(spoiled, str(order.config_path))
    if order.duration is not None:
        if not (np.isfinite(order.duration) and order.duration > 0.0):
            raise UsageError(f"--duration {order.duration}: must be a positive number of seconds")
        steps = tuple(step for step in config.steps if step.at < order.duration)
        config = configuration.replace(config, duration=order.duration, steps=steps)
    return text, config
