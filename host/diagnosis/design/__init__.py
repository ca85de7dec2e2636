"""Experiments that tell indistinguishable models apart, and their scripts."""
