"""The guardian: a tiny process that zeroes the coils when the control loop's heartbeat stops.

`watch` decides when, `process` is what runs, `client` is the flight process's end. Nothing in here, nor in
what it imports, knows numpy: the guardian starts in a few hundredths of a second and stays small.
"""
