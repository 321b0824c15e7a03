"""Simulated cities and drives, with their truth."""
