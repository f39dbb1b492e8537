"""Filters that estimate attitude, rate and slowly varying parameters from measurements."""
