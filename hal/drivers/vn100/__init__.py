"""VectorNav VN-100 inertial unit: the bytes it speaks (`codec`, `ascii`, `stream`) and its `driver`."""
