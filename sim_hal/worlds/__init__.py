"""The physical world that the devices act on and feel."""
