"""Derivatives of tensors."""

import drjit as dr
import numpy as np


def backward(tensor):
    """Backpropagate from the sum of a tensor."""
    dr.backward(dr.sum(tensor, axis=None))


def gradient(tensor):
    """Return a copy of the gradient of a tensor, float64."""
    return np.array(dr.grad(tensor), np.float64)
