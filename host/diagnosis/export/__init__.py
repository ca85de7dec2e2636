"""The extended model as a file, without the diagnosis: `write` chooses by suffix between a module and parameters."""
