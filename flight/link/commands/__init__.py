"""Packets become commands: from whom they come, what they may say, what is done."""
