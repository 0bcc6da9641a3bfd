"""Many copies of one MuJoCo model: one interface, one implementation for the CPU and one for CUDA."""
