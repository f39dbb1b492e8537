"""Tests of the simulator of the Earth and Sun camera."""
