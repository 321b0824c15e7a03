"""streetscan: street recordings to a labelled map, vehicle positions and calibrated cameras."""

__version__ = "0.1.0"
