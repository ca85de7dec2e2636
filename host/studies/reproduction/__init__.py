"""The thesis' figures and tables, reproduced: ours with the thesis' statement, and a verdict for each."""
