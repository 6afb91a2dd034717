"""SIMD vectors in kernels: LLVM vectors, and the same in NumPy if the compiler is off."""
