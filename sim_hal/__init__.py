"""What the devices would feel, and devices that answer on the wire."""
