"""Reads what a flight recorded: packets out of bytes, and the logs of a run."""
