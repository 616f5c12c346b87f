"""Numba kernels of the CPU renderer and of the losses, written on a sixteen-lane SIMD value (simd.py)."""
