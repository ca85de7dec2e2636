"""The mismatch finder put to the proof: concealed cases, verdicts of a process that sees recordings only, scores."""
