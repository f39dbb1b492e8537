"""The documentation: its commands run, its examples work, its site is complete and needs no network."""
