"""Fault detection of the coils and their bridges."""
