"""Throws as a real camera would film them, with the truth beside each image, to judge perception by.

A furnished room, a thrower, an exposure time and a sensor's noise; only benchmarks and tests render it. Needs
OpenGL (`find_gl_backend`) and, for what looks at the images, OpenCV: the extra `perception`.
"""
