"""Definitions that all parts share: serial frames, zenoh topics, rig file, enums. Imports no other package."""

from protocol import kernel_cache

kernel_cache.choose()
