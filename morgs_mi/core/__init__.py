"""The values that every subpackage speaks: cameras and Gaussians; files that appear whole or not at all."""
