"""The composition root: opens, flies and closes a configured flight.

The only package of the flight application that knows the kind of hardware: Linux's, simulated in lock-step,
or simulated in real time in a process of its own.
"""
