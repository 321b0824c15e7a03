"""Camera and lidar brought together while driving (Nagy 2020, chapter 4)."""
