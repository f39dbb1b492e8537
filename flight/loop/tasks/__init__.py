"""The tasks of the loop, named as their domain: each owns one concern and returns its results."""
