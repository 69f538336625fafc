"""Light between Gaussians and the objects of a scene."""
