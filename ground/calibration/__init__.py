"""A camera's lens from solved frames."""
