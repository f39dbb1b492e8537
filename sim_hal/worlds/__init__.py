"""The physical world that the devices measure and act on."""
