"""The thesis' figures and tables again: ours beside the thesis' statement, a verdict to each."""
