"""Simulated worlds, and emulated devices that answer at the wire."""
