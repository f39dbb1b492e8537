"""VectorNav VN-100 inertial unit: its protocol (`codec`, `ascii`, `stream`) and its `driver`."""
