"""Tests of the report: figures of performance, summary, text, pictures."""
