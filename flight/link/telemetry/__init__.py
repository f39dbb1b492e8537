"""Telemetry: packet definitions, encoding and decoding of CCSDS packets, and the flight log."""
