"""Evidence, not product: benchmarks, reproduction of the thesis, proof of the finder, control and fault campaigns."""
