"""The configuration of a run request: the file, read once, with the changes that the request asks for."""

from __future__ import annotations

import numpy as np

from flight.app.request import RunRequest
from flight.app.simulated import corrupted_text
from flight.schema import reader as configuration
from flight.schema.document import read_text
from flight.schema.sections import Config
from knightcube.errors import UsageError


def requested_config(request: RunRequest, text: str | None = None) -> tuple[str, Config]:
    """Return the configuration as text and as values, with the request's changes in the values.

    `text` is the file as it was read; without it the file is read. Raises ConfigError for the file's
    mistakes, UsageError for the request's.
    """
    text = read_text(request.config_path) if text is None else text
    config = configuration.parse(text, str(request.config_path))
    if request.faults and config.simulation is None:
        raise UsageError("--fault: this configuration flies real devices, which break by themselves")
    if request.faults:
        spoiled = corrupted_text(request, text)
        if spoiled != text:
            text, config = spoiled, configuration.parse(spoiled, str(request.config_path))
    if request.duration is not None:
        if not (np.isfinite(request.duration) and request.duration > 0.0):
            raise UsageError(f"--duration {request.duration}: must be a positive number of seconds")
        config = config.shortened(request.duration)
    return text, config
