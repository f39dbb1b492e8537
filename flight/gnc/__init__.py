"""Guidance, navigation and control: pure functions and small classes.

Nothing here knows a clock, a configuration, a device or a socket.
"""
