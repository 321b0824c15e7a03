"""Registration of rotating-lidar frames (Józsa & Benedek 2013)."""
