"""Physics outside the vocabulary: an equation found by search."""
