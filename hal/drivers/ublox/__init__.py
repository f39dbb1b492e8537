"""A u-blox GPS receiver and its UBX protocol on a serial line."""
