"""Is all well? Facts become events, events reactions, reactions a mode."""
