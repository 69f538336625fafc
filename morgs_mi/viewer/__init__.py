"""Browser viewer of streams."""
