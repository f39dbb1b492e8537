"""Simulated physical worlds, which the emulated devices measure and act on."""
