"""Communication between satellite and ground: packets, commands, frames, files and logs."""
