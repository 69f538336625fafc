"""Export of streams to the file formats of other programs."""
