"""Pictures and videos of a scene, and the images that a real camera would take in a furnished room.

Needs OpenGL without a display, which `find_gl_backend` looks for.
"""
