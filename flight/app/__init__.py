"""Assembly of the flight application, which opens, runs and closes a configured flight.

Only this package of the flight application knows which hardware is used: the real devices, devices simulated
in lock-step, or devices simulated in real time in a separate process.
"""
