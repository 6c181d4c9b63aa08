"""A search for a fast lap, which a ghost keeps."""
