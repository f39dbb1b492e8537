"""The on-board application: what the satellite does."""

__version__ = "0.1.0"
