"""Emulated devices with the registers and packets of the real devices."""
