"""Device drivers: each a protocol core without I/O (bytes in, events out) and a thin thread over a transport."""
