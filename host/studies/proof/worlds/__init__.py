"""Worlds of the proof: generators that differ in mechanism, engine and sampling from the project's own one."""
