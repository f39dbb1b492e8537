"""The bodies that the loop can control, all of which implement the same Protocols."""
