"""Commands: the channels they arrive by, their packets and their values."""
