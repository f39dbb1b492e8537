"""Tests of the documentation: commands run, examples work, and the site is complete and works offline."""
