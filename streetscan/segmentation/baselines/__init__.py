"""Reference methods of the segmentation tables, one module each."""
