"""The shape of one YAML configuration and its reader; each limit and default is written once."""
