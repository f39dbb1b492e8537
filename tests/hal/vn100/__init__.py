"""The VN-100 end to end: bytes, driver, emulator, line."""
