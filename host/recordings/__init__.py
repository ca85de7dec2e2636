"""Recordings: write, read, repair, export, and channels that Foxglove draws."""
