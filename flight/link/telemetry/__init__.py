"""Telemetry: CCSDS packets from one definition table, the flight log, its reader, its documentation."""
