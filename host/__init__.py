"""Top floor: mechanics, estimation, identification, diagnosis, recording and the command line. May import all rooms."""

from protocol import kernel_cache

kernel_cache.choose()
