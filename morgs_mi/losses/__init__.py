"""The terms of eq. 13, each a scalar Dr.Jit tensor, and the error that each Gaussian is responsible for."""
