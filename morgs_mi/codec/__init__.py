"""Residuals to bytes and back."""
