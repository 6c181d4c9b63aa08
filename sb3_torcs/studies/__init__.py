"""Many trainings, measured alike: variants by seeds, on all cores or a cluster."""
