"""The bodies that the loop can fly, each behind the same Protocols."""
