"""Tests of the report: performance results, summary, text and plots."""
