"""From a scene to its results: validation, the plan, compiled batches, resumable runs."""
