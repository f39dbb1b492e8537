"""Builds settings and tasks from a configuration."""
