"""The ground's end of the link: keys, commands with their verification, telemetry."""
