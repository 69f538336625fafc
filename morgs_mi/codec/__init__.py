"""Encoder and decoder of the stream: Gaussians to bytes and back."""
