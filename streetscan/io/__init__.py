"""Readers and writers, one module per format, each through the format's own library."""
