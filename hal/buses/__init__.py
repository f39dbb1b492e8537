"""Buses of a Linux board: serial port, I2C, video device, clock; each behind a Protocol of hal.interfaces."""
