"""Results on disk: labelled datasets, unfinished work that survives any interruption, and where numbers come from."""
