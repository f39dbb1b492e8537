"""Emulated devices in a process of their own, in real time."""
