"""The structure of a YAML configuration and its reader; each limit and default is defined once."""
