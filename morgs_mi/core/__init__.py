"""What all subpackages share: cameras, Gaussians, the attribute table, colour spaces, atomic files."""
