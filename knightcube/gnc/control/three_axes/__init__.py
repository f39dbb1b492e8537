"""Control of a free satellite by three magnetic coils alone."""
