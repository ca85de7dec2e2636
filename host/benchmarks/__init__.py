"""Benchmarks of the kernels, each beside a peer on the same inputs; `host.bench` finds and runs them."""
