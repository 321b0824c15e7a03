"""Where the vehicle is on the labelled map, from one sparse lidar frame (Nagy 2020, chapter 3)."""
