"""Buses and system services of a Linux board: serial port, I2C, clock, process priority."""
