"""The composing root: from a configuration to a flight that has ended, with everything closed behind it.

The one room of the flight application that knows which hardware there is: Linux's, simulated in lock-step,
or simulated in real time in a process of its own.
"""
