"""Checks of recordings: poses, signals, synchrony and typical mistakes."""
