"""Simulated worlds, and devices that are emulated at their bus or serial line."""
