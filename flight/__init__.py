"""The on-board application of the satellite."""

__version__ = "0.2.0"
