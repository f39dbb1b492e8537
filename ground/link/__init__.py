"""Ground end of the link to a satellite: keys, verified commands and telemetry."""
