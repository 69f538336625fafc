"""Files of pixels and of Gaussians: videos, image folders, EXR, PLY."""
