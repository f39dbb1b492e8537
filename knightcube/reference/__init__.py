"""The sources' other methods, kept to compare with the ones in use."""
