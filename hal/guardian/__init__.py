"""The guardian: a small process that zeroes the coils when the control loop's heartbeat stops.

`watch` decides when, `process` runs it, `client` is the flight process's end. Nothing here, nor in its
imports, uses numpy, so the guardian starts in a few hundredths of a second and stays small.
"""
