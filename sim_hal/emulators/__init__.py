"""Devices that answer on the wire: they hold registers and speak packets as the real parts do."""
