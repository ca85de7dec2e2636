"""The fixed-rate process: one pure tick out of small modules, the native loop, the clock and the device drivers."""

from protocol import kernel_cache

kernel_cache.choose()
