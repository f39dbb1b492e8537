"""Simulated worlds, and devices emulated at the wire."""
