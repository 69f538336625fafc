"""Exports to OpenUSD and glTF."""
