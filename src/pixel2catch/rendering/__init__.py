"""Pictures and films of a scene, and images of a camera in a furnished room. Needs OpenGL."""
