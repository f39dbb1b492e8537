"""Buses of a Linux board: serial port, I2C bus, clock; each behind a Protocol of `hal.interfaces`."""
