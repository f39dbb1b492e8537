"""A library of attitude determination, vision and magnetic control: pure functions and small classes.

Nothing here knows a clock, a configuration, a device or a socket.
"""
