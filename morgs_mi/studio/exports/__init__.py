"""Exports to OpenUSD and glTF, tracks and panoramas."""
