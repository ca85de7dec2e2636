"""Inputs of a diagnosis: the nominal model's file, recordings, ports, candidate effects and their operators."""
