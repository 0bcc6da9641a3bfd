"""The RGB camera: its image and the object's box; surface points → visible points → box → pixel features.

Pure functions on tensors with one row per environment: no simulation, no renderer, no host synchronisation.

Image coordinates are continuous: pixel column i covers [i, i + 1], u grows to the right and v downwards, the
image is [0, width] x [0, height]. A box is (xmin, ymin, xmax, ymax) [px] in these coordinates.
"""
