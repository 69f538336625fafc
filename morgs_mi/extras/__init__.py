"""What some users need. Each folder can be deleted; it enters itself by `platform.extras`."""
