"""The on-board application: what the satellite does."""
