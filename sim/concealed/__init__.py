"""Generator of the proof: recordings with concealed physics, labels kept apart. Written apart from the finder."""
