"""Ground floor: the words that every part speaks - serial frames and zenoh topics. Imports no other room."""

from protocol import kernel_cache

kernel_cache.choose()
