"""Transfer frames: telecommand (CCSDS 232.0-B) and telemetry (132.0-B), and the streams that carry them."""
