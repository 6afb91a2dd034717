"""Differentiable rasterization for training, on the CPU or on CUDA."""
