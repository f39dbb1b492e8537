"""VectorNav VN-100 inertial unit: serial protocol and driver."""
