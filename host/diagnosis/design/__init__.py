"""Experiments that separate indistinguishable models, and their scripts."""
