"""Proof of the mismatch finder: concealed cases, verdicts of a process that gets only recordings, scores."""
