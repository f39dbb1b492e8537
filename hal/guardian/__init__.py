"""The guardian: a small process that zeroes the coils when the control loop's heartbeat stops.

`process` runs the guardian, `client` is the flight process's end. Neither these modules nor their imports use
numpy, so the guardian starts in a few hundredths of a second and stays small.
"""
