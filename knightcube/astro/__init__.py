"""Quaternions, directions, frames and array types."""
