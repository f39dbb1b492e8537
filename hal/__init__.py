"""How devices are talked to: buses know Linux, drivers know a part's registers."""
