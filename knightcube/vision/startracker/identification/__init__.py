"""Which stars a frame shows: lost in space and tracking."""
