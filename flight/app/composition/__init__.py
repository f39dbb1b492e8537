"""From a configuration to settings and tasks: the one place that composes."""
