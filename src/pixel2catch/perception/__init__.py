"""From the RGB stream to the pixel features: image → mask → box → z.

The segmenters find the object's pixels, the extractor makes of them what training gave to the policies, with
the very functions of `camera/`. Needs OpenCV: the extra `perception`.
"""
