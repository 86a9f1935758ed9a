"""Everything into one recording, and back out of it for review; knows Rerun, and of the project only the vocabulary."""
