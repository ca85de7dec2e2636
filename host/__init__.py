"""What may take its time: mechanics, estimation, identification, diagnosis, recordings, reports and the command line."""

from protocol import kernel_cache

kernel_cache.choose()
