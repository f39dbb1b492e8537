"""VectorNav VN-100 inertial unit: its `protocol` and its `driver`."""
