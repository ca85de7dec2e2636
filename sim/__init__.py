"""The simulated rig. Its physics is written separately from the models in `host` that are tested on it."""

from protocol import kernel_cache

kernel_cache.choose()
