"""Star detection."""
