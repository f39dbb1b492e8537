"""Guidance: from a state estimate to an energy-optimal path, and which path is flown."""
