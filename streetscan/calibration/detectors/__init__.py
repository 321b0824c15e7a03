"""Detectors of what could move, in images and in lidar frames: one call each, whatever the network behind it.

An image detector has `detect(image) -> ImageDetections`, a lidar detector `detect(points, intensity) -> LidarDetections`.
Everything that could move counts, parked cars too: what stands today is gone on the next day, and its outline is as little
a landmark.

Source: Nagy (2020), 4.3.1 (2) (Mask R-CNN) and 4.3.2.1 (PointPillars); N-205, N-215.
"""
