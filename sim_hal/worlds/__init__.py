"""Simulated physical worlds, in which the emulated devices measure and apply torques."""
