"""Wings that some users need; nothing outside of this subpackage imports it, see `core.entries`."""
