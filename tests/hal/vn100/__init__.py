"""Tests of the VN-100: bytes, driver, emulator and serial line."""
