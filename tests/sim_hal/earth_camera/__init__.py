"""Tests of the Earth and Sun camera's simulator."""
