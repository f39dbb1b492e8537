"""What space and ground say to each other: packets, commands, logs."""
