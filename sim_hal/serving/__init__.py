"""Emulated devices that run in a separate process in real time."""
