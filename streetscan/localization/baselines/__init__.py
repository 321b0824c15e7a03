"""Other ways to find a frame on the map, one module each, with the same interface as the voting localizer."""
