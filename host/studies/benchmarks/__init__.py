"""Benchmarks of the kernels, each with a peer on the same inputs; `host.studies.benchmarks.runner` finds and runs them."""
