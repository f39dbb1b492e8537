"""The link process: radio lines, live telemetry, playback, and commands with their verification.

The link process reads the growing flight log and writes to the command socket. The control loop never waits
for the link process.
"""
