"""Labelling of voxels: C²CNN (Nagy 2020, ch. 2) and its reference methods."""
