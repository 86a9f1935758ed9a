"""State-space models, one file each."""
