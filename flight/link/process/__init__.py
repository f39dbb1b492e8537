"""The link process: radio lines, live telemetry, playback, and commands with their verification.

Follows the flight log and writes to the command socket; the control loop waits for nothing of it.
"""
