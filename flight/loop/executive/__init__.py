"""Fixed-rate groups on an injected clock, and the workers for long jobs."""
