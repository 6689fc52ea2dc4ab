"""Results on disk: labelled datasets, unfinished work that survives interruptions, and provenance."""
