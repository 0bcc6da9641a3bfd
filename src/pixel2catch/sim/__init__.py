"""Many copies of one MuJoCo model: one interface, for the CPU, for CUDA, and for other engines' physics."""
