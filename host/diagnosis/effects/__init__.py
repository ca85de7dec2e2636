"""The vocabulary of missing physics, one small module an effect, found by name."""
