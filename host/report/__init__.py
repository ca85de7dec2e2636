"""Reports of a run: figures, summary and HTML pages."""
