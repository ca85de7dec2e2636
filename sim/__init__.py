"""The rig that stands in for steel. Its physics is written apart from the models in `host` that are judged on it."""

from protocol import kernel_cache

kernel_cache.choose()
