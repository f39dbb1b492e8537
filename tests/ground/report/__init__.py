"""Tests of the report: performance figures, summary, text and plots."""
