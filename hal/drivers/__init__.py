"""Device drivers, each for the registers or packets of one device."""
